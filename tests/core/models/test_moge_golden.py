"""MoGe v1 with and without DyFN against outputs of the released implementations."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from dyfn_core.models import load_model
from dyfn_core.models.base import GeometryModel, image_to_batch
from dyfn_core.models.moge import MoGeModel
from dyfn_core.prediction import Prediction

TOKENS = 300
# The released focal/shift solver stops early; ours goes to the optimum (golden README).
LOOSE_FOCAL, LOOSE_SHIFT = 4e-4, 7e-4

Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def golden(shared_dir: Path) -> Arrays:
    return dict(np.load(shared_dir / "golden" / "A_320x240_tok300.npz"))


@pytest.fixture(scope="module")
def frames(shared_dir: Path) -> np.ndarray:
    return np.load(shared_dir / "golden" / "video_320x240.npz")["frames"]


@pytest.fixture(scope="module")
def checkpoint(shared_dir: Path) -> Path:
    return shared_dir / "golden" / "ckpt_A_dyfn_convgru_vits.pt"


@pytest.fixture(scope="module")
def model(checkpoint: Path) -> GeometryModel:
    return load_model(checkpoint)


@pytest.fixture(scope="module")
def base(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> GeometryModel:
    """Case C: the same weights as a plain MoGe v1 checkpoint."""
    content = torch.load(checkpoint, weights_only=True)
    del content["model_config"]["stabilizer_type"]
    content["model"] = {
        key: value
        for key, value in content["model"].items()
        if not key.startswith("head.stabilizer.")
    }
    path = tmp_path_factory.mktemp("case_c") / "model.pt"
    torch.save(content, path)
    return load_model(path)


@pytest.fixture(scope="module")
def clip(model: GeometryModel, frames: np.ndarray) -> list[Prediction]:
    """Eight frames with the state passed along."""
    predictions: list[Prediction] = []
    for frame in frames:
        state = predictions[-1].state if predictions else None
        predictions.append(model.infer(frame, state, num_tokens=TOKENS))
    return predictions


def assert_depth(got: torch.Tensor, want: np.ndarray, stride: int, loose: float) -> None:
    depth = got.numpy()[..., ::stride, ::stride]
    assert np.mean(np.isfinite(depth) != np.isfinite(want)) < 1e-3
    both = np.isfinite(depth) & np.isfinite(want)
    excess = np.abs(depth[both] - want[both]) - 1e-3 * np.abs(want[both])
    assert excess.max() <= loose


def assert_points(got: torch.Tensor, want: np.ndarray) -> None:
    points = got.numpy()[..., ::4, ::4, :]
    both = np.isfinite(points) & np.isfinite(want)
    assert both.any()
    np.testing.assert_allclose(points[both], want[both], rtol=1e-3, atol=3e-3)


def test_latent_and_stabilized_latent_match_over_the_clip(
    model: GeometryModel, golden: Arrays, frames: np.ndarray
) -> None:
    state = None
    with torch.inference_mode():
        for index, frame in enumerate(frames):
            image, _ = image_to_batch(frame)
            latent = model.encode(image, TOKENS)
            after, state = model.stabilize_latent(latent, state)
            for got, name in (
                (latent.features[0], "features_before_stabilizer"),
                (after.features[0], "features_after_stabilizer"),
                (state.hidden[0, :, ::2, ::2], "hidden_state"),
            ):
                np.testing.assert_allclose(got.numpy(), golden[name][index], atol=1e-3)


def test_encoder_layers_match(model: MoGeModel, golden: Arrays) -> None:
    with torch.inference_mode():
        layers = model.backbone(torch.from_numpy(golden["backbone_input_frame0"]), 4)
    for index, layer in enumerate(layers):
        tokens = layer.flatten(2).transpose(1, 2)[:, ::2].numpy()
        np.testing.assert_allclose(tokens, golden[f"backbone_feat{index}_frame0"], atol=1e-3)


def test_affine_points_and_mask_match(
    model: GeometryModel, golden: Arrays, frames: np.ndarray
) -> None:
    state = None
    with torch.inference_mode():
        for index in range(2):
            image, _ = image_to_batch(frames[index])
            affine, state = model.predict_affine(image, state, TOKENS)
            points = affine.points[0, ::4, ::4].numpy()
            want = golden["points_remapped"][index]
            np.testing.assert_allclose(points, want, rtol=1e-3, atol=1e-4)
            mask = affine.mask[0, ::4, ::4].numpy()
            np.testing.assert_allclose(mask, golden["mask_resized"][index], atol=1e-3)


def test_infer_matches_over_the_clip(clip: list[Prediction], golden: Arrays) -> None:
    for index, prediction in enumerate(clip):
        want = golden["infer_fovNone_projTrue.depth"][index]
        loose = abs(
            golden["infer_fovNone_projTrue.shift"][index] - golden["exact_focal_shift"][index, 1]
        )
        assert loose <= LOOSE_SHIFT
        assert_depth(prediction.depth, want, 2, loose + 1e-5)
        assert_points(prediction.points, golden["infer_fovNone_projTrue.points"][index])
        np.testing.assert_allclose(
            prediction.intrinsics.numpy(),
            golden["infer_fovNone_projTrue.intrinsics"][index],
            rtol=LOOSE_FOCAL,
        )
        flips = prediction.mask.numpy() != golden["infer.mask"][index]
        assert flips.mean() < 1e-3


def test_recovered_camera_is_the_exact_optimum(clip: list[Prediction], golden: Arrays) -> None:
    for prediction, (focal, _) in zip(clip, golden["exact_focal_shift"], strict=True):
        fy = prediction.intrinsics[1, 1].item()
        assert fy == pytest.approx(focal / 2 * np.hypot(320 / 240, 1), rel=1e-5)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("infer_fovNone_projFalse", {"force_projection": False}),
        ("infer_fov60_projTrue", {"fov_x": 60}),
        ("infer_fov60_projFalse", {"fov_x": 60, "force_projection": False}),
    ],
)
def test_infer_options_match(
    name: str,
    options: dict,
    model: GeometryModel,
    clip: list[Prediction],
    golden: Arrays,
    frames: np.ndarray,
) -> None:
    prediction = model.infer(frames[4], clip[3].state, num_tokens=TOKENS, **options)
    assert_depth(prediction.depth, golden[f"{name}.depth"][4], 4, LOOSE_SHIFT)
    assert_points(prediction.points, golden[f"{name}.points"][4])
    np.testing.assert_allclose(
        prediction.intrinsics.numpy(), golden[f"{name}.intrinsics"][4], rtol=LOOSE_FOCAL
    )


def test_without_mask_everything_is_finite_and_matches(
    model: GeometryModel, clip: list[Prediction], golden: Arrays, frames: np.ndarray
) -> None:
    prediction = model.infer(frames[1], clip[0].state, num_tokens=TOKENS, apply_mask=False)
    assert_depth(prediction.depth, golden["infer_nomask.depth"][1], 4, LOOSE_SHIFT)
    assert torch.isfinite(prediction.points).all()


def test_stabilizer_off_matches_image_based_inference(
    model: GeometryModel, golden: Arrays, frames: np.ndarray
) -> None:
    prediction = model.infer(frames[1], num_tokens=TOKENS, stabilize=False)
    assert prediction.state is None
    assert_depth(prediction.depth, golden["infer_imagebased.depth"][1], 4, LOOSE_SHIFT)


def test_batch_of_two_streams_matches(
    model: GeometryModel, golden: Arrays, frames: np.ndarray
) -> None:
    state = None
    for pair, want in zip(golden["infer_batch.frames"], golden["infer_batch.depth"], strict=True):
        prediction = model.infer(frames[pair], state, num_tokens=TOKENS)
        state = prediction.state
        assert_depth(prediction.depth, want, 4, LOOSE_SHIFT)


def test_plain_moge_matches(
    base: GeometryModel, golden_file: Callable[[str], Path], frames: np.ndarray
) -> None:
    golden = np.load(golden_file("C_320x240_frame0.npz"))
    frame = frames[golden["frame_index"][0]]
    prediction = base.infer(frame, num_tokens=TOKENS)
    name = "tok300.infer_fovNone_projTrue"
    assert prediction.state is None
    assert_depth(prediction.depth, golden[f"{name}.depth"][0], 1, LOOSE_SHIFT)
    assert_points(prediction.points, golden[f"{name}.points"][0])
    assert (prediction.mask.numpy() != golden["tok300.infer.mask"][0]).mean() < 1e-3
    name = "tok300.infer_fov60_projFalse"
    prediction = base.infer(frame, num_tokens=TOKENS, fov_x=60, force_projection=False)
    assert_depth(prediction.depth, golden[f"{name}.depth"][0], 4, LOOSE_SHIFT)
    assert_points(prediction.points, golden[f"{name}.points"][0])


@pytest.mark.parametrize("size", [(240, 320), (101, 157)])
def test_stabilizer_off_is_the_plain_checkpoint_bit_for_bit(
    model: GeometryModel, base: GeometryModel, frames: np.ndarray, size: tuple[int, int]
) -> None:
    frame = np.ascontiguousarray(frames[2][: size[0], : size[1]])
    off = model.infer(frame, num_tokens=90, stabilize=False)
    plain = base.infer(frame, num_tokens=90)
    for one, other in (
        (off.points, plain.points),
        (off.depth, plain.depth),
        (off.mask, plain.mask),
        (off.intrinsics, plain.intrinsics),
    ):
        assert torch.equal(one, other)
