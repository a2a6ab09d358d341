"""Depth Anything V2: equal to the official code, loaded strictly, honest about disparity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from dyfn_core.evaluation.sequence import SequenceEvaluation
from dyfn_core.evaluation.variants import score_variants
from dyfn_core.models.checkpoints import (
    CheckpointError,
    build_model,
    load_model,
    read_checkpoint,
    save_model,
)
from dyfn_core.models.depth_anything import DepthAnythingConfig, DepthAnythingModel
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.scoring.protocols import SequenceScorer
from dyfn_core.stream.depth_stream import DepthStream, push_together


@pytest.fixture(scope="module")
def official_file(shared_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden head with the golden encoder under its official names."""
    golden = shared_dir / "golden"
    weights = torch.load(golden / "ckpt_D_dav2_vits_depth_head_only.pt", weights_only=True)
    other = torch.load(golden / "ckpt_A_dyfn_convgru_vits.pt", weights_only=True)["model"]
    for key, value in other.items():
        if key.startswith("backbone."):
            weights[key.replace("backbone.", "pretrained.", 1)] = value
    path = tmp_path_factory.mktemp("official") / "depth_anything_v2_vits.pth"
    torch.save(weights, path)
    return path


@pytest.fixture(scope="module")
def model(official_file: Path) -> DepthAnythingModel:
    loaded = load_model(official_file)
    assert isinstance(loaded, DepthAnythingModel)
    return loaded


@pytest.fixture(scope="module")
def wanted(shared_dir: Path) -> dict[str, np.ndarray]:
    with np.load(shared_dir / "golden" / "D_frame0.npz") as found:
        return {key: found[key] for key in found.files}


@pytest.fixture(scope="module")
def untrained() -> DepthAnythingModel:
    """Random weights that give positive, varied disparity."""
    torch.manual_seed(0)
    made = DepthAnythingModel(DepthAnythingConfig(input_size=56)).eval()
    torch.nn.init.constant_(made.depth_head.scratch.output_conv2[2].bias, 0.5)  # type: ignore[arg-type]
    return made


@pytest.mark.parametrize("size", ["308x238", "266x182"])
@torch.inference_mode()
def test_network_matches_the_official_one(
    model: DepthAnythingModel, wanted: dict[str, np.ndarray], size: str
) -> None:
    case = f"forward_{size}"
    image = torch.from_numpy(wanted[f"{case}.input_u8"]).permute(0, 3, 1, 2).float() / 255
    normalised = (image - model.image_mean) / model.image_std
    for index, layer in enumerate(model.pretrained(normalised, model.variant.blocks)):
        tokens = layer[0].flatten(1).T[::8]
        expected = torch.from_numpy(wanted[f"{case}.feat{index}_frame0"])
        torch.testing.assert_close(tokens, expected, rtol=0, atol=1e-3)
    cells = image.shape[-2] * image.shape[-1] // 14**2
    latent = model.encode(image, cells)
    assert latent.network_size == tuple(image.shape[-2:])
    disparity = model.decode(latent).disparity[:, ::2, ::2]
    expected = torch.from_numpy(wanted[f"{case}.depth"])
    torch.testing.assert_close(disparity, expected, rtol=1e-3, atol=1e-4)


@torch.inference_mode()
def test_images_are_prepared_as_officially(
    model: DepthAnythingModel, wanted: dict[str, np.ndarray], shared_dir: Path
) -> None:
    case = "infer_image_s252_frame0"
    with np.load(shared_dir / "golden" / "video_320x240.npz") as video:
        image = video["frames"][int(wanted["frame_index"][0])]
    small = DepthAnythingModel(DepthAnythingConfig(input_size=252)).eval()
    small.load_state_dict(model.state_dict())
    assert small.network_size((240, 320), None) == tuple(wanted[f"{case}.net_hw"].tolist())
    prediction = small.infer(image)
    assert prediction.quantity == "disparity"
    assert prediction.disparity is not None
    expected = torch.from_numpy(wanted[f"{case}.depth"])
    torch.testing.assert_close(prediction.disparity[::2, ::2], expected, rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("encoder", "parameters"),
    [("dinov2_vits14", 24_785_089), ("dinov2_vitb14", 97_470_785), ("dinov2_vitl14", 335_315_649)],
)
def test_sizes_are_the_published_ones(encoder: str, parameters: int) -> None:
    with torch.device("meta"):
        made = DepthAnythingModel(DepthAnythingConfig(encoder=encoder))
    assert sum(p.numel() for p in made.parameters()) == parameters


def test_damaged_official_file_names_every_key(official_file: Path, tmp_path: Path) -> None:
    weights = torch.load(official_file, weights_only=True)
    weights["depth_head.scratch.refinenet1.out_cnv.bias"] = weights.pop(
        "depth_head.scratch.refinenet1.out_conv.bias"
    )
    path = tmp_path / "renamed.pth"
    torch.save(weights, path)
    with pytest.raises(CheckpointError) as e:
        load_model(path)
    assert "missing: depth_head.scratch.refinenet1.out_conv.bias (64)" in str(e.value)
    assert "did you mean 'depth_head.scratch.refinenet1.out_conv.bias'?" in str(e.value)


def test_encoder_of_another_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "giant.pth"
    torch.save({"pretrained.cls_token": torch.zeros(1, 1, 1536)}, path)
    with pytest.raises(CheckpointError, match="1536 channels is none of"):
        load_model(path)


def test_our_format_keeps_model_and_stabilizer(
    untrained: DepthAnythingModel, tmp_path: Path
) -> None:
    made = DepthAnythingModel(untrained.settings).eval()
    made.load_state_dict(untrained.state_dict())
    made.stabilizer = build_dyfn(made.latent_channels, DyFNConfig(hidden=8, pool=4))
    save_model(made, tmp_path / "model.safetensors")
    loaded = build_model(read_checkpoint(tmp_path / "model.safetensors"), "file").eval()
    image = np.random.default_rng(0).integers(0, 255, (56, 70, 3), np.uint8)
    torch.testing.assert_close(loaded.infer(image).depth, made.eval().infer(image).depth)


def frames(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [rng.integers(0, 255, (56, 70, 3)).astype(np.uint8) for _ in range(count)]


def test_stream_holds_the_first_frames_unit(untrained: DepthAnythingModel) -> None:
    stream = DepthStream(untrained)
    first, second = (stream.push(image) for image in frames(2))
    assert first.quantity == second.quantity == "disparity"
    assert first.disparity is not None
    assert second.disparity is not None
    unit = first.disparity[first.disparity > 0].median()
    for prediction in (first, second):
        disparity = prediction.disparity
        valid = prediction.mask
        torch.testing.assert_close(prediction.depth[valid], unit / disparity[valid])  # type: ignore[index]
        assert bool(torch.isinf(prediction.depth[~valid]).all())
    alone = DepthStream(untrained).push(frames(2)[1])
    assert not torch.allclose(alone.depth[alone.mask], second.depth[alone.mask])


def test_streams_of_disparity_share_a_batch(untrained: DepthAnythingModel) -> None:
    images = frames(2)
    together = push_together([DepthStream(untrained), DepthStream(untrained)], images)
    for image, found in zip(images, together, strict=True):
        torch.testing.assert_close(found.depth, DepthStream(untrained).push(image).depth)


def test_known_camera_shapes_the_points(untrained: DepthAnythingModel) -> None:
    matrix = np.array([[80.0, 0, 34.5], [0, 80.0, 27.5], [0, 0, 1]])
    found = DepthStream(untrained, matrix).push(frames(1)[0])
    assert float(found.intrinsics[0, 0]) == pytest.approx(80 / 70)
    valid: Tensor = found.mask
    torch.testing.assert_close(found.points[..., 2][valid], found.depth[valid])


def test_image_without_any_disparity_is_nowhere_valid(untrained: DepthAnythingModel) -> None:
    made = DepthAnythingModel(untrained.settings).eval()
    made.load_state_dict(untrained.state_dict())
    torch.nn.init.constant_(made.depth_head.scratch.output_conv2[2].bias, -1e6)  # type: ignore[arg-type]
    for found in (made.infer(frames(1)[0]), DepthStream(made).push(frames(1)[0])):
        assert not bool(found.mask.any())
        assert bool(torch.isinf(found.depth).all())


def test_disparity_is_scored_in_disparity_space() -> None:
    """a / z + b with an offset: perfect when aligned as disparity, poor as inverse depth."""
    depth = np.linspace(1, 9, 4000).reshape(50, 80).astype(np.float32)
    disparity = (3 / depth + 0.5).astype(np.float32)
    honest, naive = SequenceScorer(quantity="disparity"), SequenceScorer()
    for _ in range(3):
        honest.push(disparity, depth)
        naive.push(1 / disparity, depth)
    for protocol in ("image", "video"):
        ours, theirs = getattr(honest, protocol)(), getattr(naive, protocol)()
        assert ours.metrics["abs_rel"] < 1e-4
        assert theirs.metrics["abs_rel"] > 0.02
    assert honest.metric() is None


def test_unknown_quantity_is_refused() -> None:
    with pytest.raises(ValueError, match="'inverse'"):
        SequenceScorer(quantity="inverse")


def test_a_whole_evaluation_aligns_disparity_and_draws_depth() -> None:
    depth = np.linspace(1, 9, 4000).reshape(50, 80).astype(np.float32)
    image = np.zeros((50, 80, 3), np.uint8)
    evaluation = SequenceEvaluation(3, quantity="disparity")
    for index in range(3):
        disparity = (3 / depth + 0.5).astype(np.float32)
        valid = np.ones(depth.shape, bool)
        evaluation.push(image, disparity, valid, depth, stamp=float(index), latency=0.01)
    results = evaluation.results()
    assert results["image"]["abs_rel"] < 1e-4
    assert results["video"]["abs_rel"] < 1e-4
    # The ramp falls from top to bottom, where this depth grows: a control stays a depth.
    assert results["controls"]["constant"]["video"]["abs_rel"] > 0.1
    exact = SequenceEvaluation(3)
    for index in range(3):
        exact.push(image, depth, np.ones(depth.shape, bool), depth, stamp=index, latency=0.01)
    apart = evaluation.draw_strip().astype(int) - exact.draw_strip().astype(int)
    assert np.abs(apart).max() <= 2


@torch.inference_mode()
def test_controls_score_a_disparity_model_as_disparity(untrained: DepthAnythingModel) -> None:
    """Truth made of the model's own disparity: the base has no error, the scene's flat one has."""
    images = frames(2)
    truths = []
    for image in images:
        disparity = untrained.infer(image).disparity
        assert disparity is not None
        truths.append((1 / (2 * disparity + 0.1)).numpy())
    scores = score_variants(untrained, [lambda: zip(images, truths, strict=True)])
    assert scores["base"].video_abs_rel < 1e-3
    assert scores["base"].image_abs_rel < 1e-3
    assert scores["frozen"].video_abs_rel > 1e-3
