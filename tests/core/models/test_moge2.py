"""MoGe v2: equal to the official code, metres and normals, loaded strictly."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dyfn_core.models.checkpoints import CheckpointError, load_model, save_model
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.moge2 import MoGe2Model, token_grid
from tests.support.bases import moge2_config, small_moge2
from tests.support.golden2 import Golden2, batch_of, close

FULL = (240, 320)
SMALL_STEPS, STEPS, SQUARE_STEPS = (3, 6, 10, 20, 20), (5, 10, 15, 20, 20), (8, 16, 32, 64, 64)


@pytest.fixture(scope="module")
def model(golden2: Golden2, tmp_path_factory: pytest.TempPathFactory) -> MoGe2Model:
    """The small golden model, read from a file in the official format."""
    loaded = load_model(golden2.moge_file("moge2_small", tmp_path_factory.mktemp("g") / "model.pt"))
    assert isinstance(loaded, MoGe2Model)
    return loaded


def check_forward(
    model: MoGe2Model,
    wanted: dict[str, np.ndarray],
    image: np.ndarray,
    tokens: int,
    steps: tuple[int, ...],
) -> None:
    """Everything between picture and forward's dict; steps: of the neck's stored maps."""
    latent = model.encode(batch_of(image), tokens)
    assert latent.features.shape[-2:] == tuple(wanted["patch_hw"])
    step = -(-latent.features.shape[2] // wanted["encoder"].shape[1])
    close(latent.features[0, :, ::step, ::step], wanted["encoder"])
    assert latent.summary is not None
    last = sorted(key for key in wanted if key.endswith(".cls"))[-1]
    close(latent.summary[0], wanted[last])
    for level, found in enumerate(model.levels(latent)):
        expected = wanted[f"neck{level}"]
        channels = -(-found.shape[1] // expected.shape[0])
        close(found[0, ::channels, :: steps[level], :: steps[level]], expected)
    affine = model.decode_all(latent)
    step = -(-image.shape[0] // wanted["forward.points"].shape[0])
    close(affine.points[0, ::step, ::step], wanted["forward.points"], rtol=1e-4, atol=1e-5)
    assert affine.normal is not None
    assert affine.metric_scale is not None
    close(affine.normal[0, ::step, ::step], wanted["forward.normal"], atol=1e-4)
    close(affine.metric_scale, wanted["forward.metric_scale"], rtol=1e-5)
    probability = torch.sigmoid(affine.mask[0, ::step, ::step])
    close(probability, wanted["forward.mask_prob"], atol=1e-4)


@pytest.mark.parametrize(
    ("case", "frame", "size", "tokens", "steps"),
    [
        ("f0_320x240_tok300", 0, FULL, 300, SMALL_STEPS),
        ("f0_317x203_tok300", 0, (203, 317), 300, SMALL_STEPS),
        pytest.param(  # the only grid whose position embedding is not resized
            "f0_240x240_tok1369", 0, (240, 240), 1369, SQUARE_STEPS, marks=pytest.mark.slow
        ),
    ],
)
@torch.inference_mode()
def test_network_matches_the_official_one(
    golden2: Golden2,
    model: MoGe2Model,
    case: str,
    frame: int,
    size: tuple[int, int],
    tokens: int,
    steps: tuple[int, ...],
) -> None:
    wanted = golden2.arrays("moge2_small_main", case)
    check_forward(model, wanted, golden2.frame(frame, size), tokens, steps)


@pytest.mark.parametrize(
    ("case", "size"),
    [
        ("f0_320x240_tok300", FULL),
        ("f0_120x240_tok300", (240, 120)),
    ],
)
def test_infer_matches_the_official_one(
    golden2: Golden2, model: MoGe2Model, case: str, size: tuple[int, int]
) -> None:
    """Metres, normals and mask. The official solver stops early: its own shift is put back."""
    wanted = golden2.arrays("moge2_small_main", case)
    found = model.infer(golden2.frame(0, size), num_tokens=300)
    assert found.metric
    assert found.quantity == "depth"
    assert found.normal is not None
    focal, shift = wanted["infer.exact_focal_shift"][0]
    aspect = size[1] / size[0]
    assert float(found.intrinsics[1, 1]) == pytest.approx(focal / 2 * np.hypot(aspect, 1), rel=1e-4)
    packed = np.unpackbits(wanted["infer.mask"], axis=1)[:, : size[1]].astype(bool)
    assert (packed != found.mask.numpy()).mean() <= 1e-3
    with torch.inference_mode():
        affine = model.decode(model.encode(batch_of(golden2.frame(0, size)), 300))
    assert affine.metric_scale is not None
    moved = float(affine.metric_scale) * (float(wanted["infer.shift"][0]) - shift)
    depth = found.depth.numpy()[::4, ::4] + moved
    both = np.isfinite(wanted["infer.depth"]) & np.isfinite(depth)
    np.testing.assert_allclose(depth[both], wanted["infer.depth"][both], rtol=1e-3)
    np.testing.assert_allclose(
        found.normal.numpy()[::8, ::8], wanted["infer.normal"], rtol=0, atol=1e-4
    )


@torch.inference_mode()
def test_known_field_of_view_leaves_the_shift(golden2: Golden2, model: MoGe2Model) -> None:
    wanted = golden2.arrays("moge2_small_main", "f0_320x240_tok300.infer_fov60")
    found = model.infer(golden2.frame(0), num_tokens=300, fov_x=60.0)
    np.testing.assert_allclose(found.intrinsics, wanted["intrinsics"], rtol=1e-5, atol=1e-6)
    _, shift = wanted["exact_focal_shift"][0]
    affine = model.decode(model.encode(batch_of(golden2.frame(0)), 300))
    assert affine.metric_scale is not None
    moved = float(affine.metric_scale) * (float(wanted["shift"][0]) - shift)
    depth = found.depth.numpy()[::4, ::4] + moved
    both = np.isfinite(wanted["depth"]) & np.isfinite(depth)
    np.testing.assert_allclose(depth[both], wanted["depth"][both], rtol=1e-3)


def test_a_batch_is_its_images(golden2: Golden2, model: MoGe2Model) -> None:
    images = np.stack([golden2.frame(0), golden2.frame(4)])
    together = model.infer(images, num_tokens=60)
    for index, image in enumerate(images):
        torch.testing.assert_close(model.infer(image, num_tokens=60).depth, together.depth[index])


@torch.inference_mode()
def test_latent_reaches_points_but_not_metres(golden2: Golden2, model: MoGe2Model) -> None:
    latent = model.encode(batch_of(golden2.frame(0)), 300)
    wanted = golden2.arrays("moge2_small_main", "f0_320x240_tok300.latent_times_2")
    found = model.decode(replace(latent, features=2 * latent.features))
    close(found.points[0, ::8, ::8], wanted["forward.points"], rtol=1e-4, atol=1e-5)
    assert found.metric_scale is not None
    assert torch.equal(found.metric_scale, model.decode(latent).metric_scale)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "name",
    ["moge2_small", "moge2_vits_normal", "moge2_vitb_normal", "moge2_vitl_normal", "moge2_vitl"],
)
def test_names_and_shapes_are_the_released_ones(golden2: Golden2, name: str) -> None:
    spec = golden2.spec(name)
    with torch.device("meta"):
        made = MoGe2Model.from_config(spec["model_config"])
    found = {key: list(value.shape) for key, value in made.state_dict().items()}
    assert found == {key: value["shape"] for key, value in spec["keys"].items()}
    assert made.has_normals == ("normal" in name or name == "moge2_small")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["moge2_vits_normal", "moge2_vitb_normal", "moge2_vitl_normal"])
@torch.inference_mode()
def test_released_shapes_match(golden2: Golden2, name: str) -> None:
    if name != "moge2_vits_normal" and not os.environ.get("DYFN_LARGE"):
        pytest.skip("set DYFN_LARGE=1 to make up to 1.3 GB of weights (a minute each)")
    made = MoGe2Model.from_config(golden2.spec(name)["model_config"]).eval()
    made.load_state_dict(golden2.weights(name), assign=True)
    wanted = golden2.arrays(f"{name}_main", "f0_320x240_tok300")
    check_forward(made, wanted, golden2.frame(0), 300, STEPS)


# Without the golden files.


def picture(seed: int = 0, size: tuple[int, int] = (60, 80)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (*size, 3)).astype(np.uint8)


def test_prediction_has_metres_and_unit_normals() -> None:
    found = small_moge2().infer(picture())
    assert found.metric
    assert found.normal is not None
    length = found.normal.norm(dim=-1)
    assert bool((length[~found.mask] == 0).all())
    torch.testing.assert_close(length[found.mask], torch.ones_like(length[found.mask]))
    bare = small_moge2(normal_head=None, scale_head=None).infer(picture())
    assert bare.normal is None
    assert not bare.metric


def test_without_a_mask_every_pixel_in_front_is_valid() -> None:
    found = small_moge2(mask_head=None).infer(picture())
    assert bool(found.mask.any())
    assert torch.equal(found.mask, torch.isfinite(found.depth))


def test_dyfn_leaves_the_metres_of_an_image_alone() -> None:
    """Metres are those of the image's own latent, whatever DyFN makes of the scale."""
    made = small_moge2()
    made.stabilizer = build_dyfn(made.latent_channels, DyFNConfig(hidden=4))
    torch.nn.init.constant_(made.stabilizer.gamma_head.bias, 4.0)  # type: ignore[arg-type,union-attr]
    torch.nn.init.constant_(made.stabilizer.beta_head.bias, 5.0)  # type: ignore[arg-type,union-attr]
    own = made.infer(picture(), stabilize=False)
    found = made.infer(picture())
    both = own.mask & found.mask
    ratio = (own.depth / found.depth)[both].median()
    assert float(ratio) == pytest.approx(1.0, abs=0.02)
    with torch.inference_mode():
        latent = made.encode(batch_of(picture()))
        moved = made.decode(made.stabilized(latent, None)[0]).points[..., 2].median()
        before = made.decode(latent).points[..., 2].median()
    assert abs(float(moved / before) - 1) > 0.1  # else this test could not fail


@pytest.mark.parametrize(
    ("size", "tokens", "grid"),
    [((240, 320), 300, (15, 20)), ((100, 100), 1, (1, 1)), ((10, 1000), 4, (1, 20))],
)
def test_token_grid(size: tuple[int, int], tokens: int, grid: tuple[int, int]) -> None:
    assert token_grid(size, tokens) == grid


def test_our_format_keeps_model_and_stabilizer(tmp_path: Path) -> None:
    made = small_moge2()
    made.stabilizer = build_dyfn(made.latent_channels, DyFNConfig(hidden=4))
    save_model(made, tmp_path / "model.safetensors")
    loaded = load_model(tmp_path / "model.safetensors")
    found, wanted = loaded.infer(picture()), made.infer(picture())
    assert torch.equal(found.depth, wanted.depth)
    assert torch.equal(found.normal, wanted.normal)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"neck": {"resamplers": "pixel_shuffle"}}, "neck: resamplers 'pixel_shuffle' is not"),
        ({"neck": {"res_block_in_norm": "layer_norm"}}, "neck: res_block_in_norm 'layer_norm'"),
        ({"points_head": {"activation": "silu"}}, "points_head: activation 'silu' is not"),
        ({"encoder": {"backbone": "dinov2_vitg14"}}, "encoder.backbone 'dinov2_vitg14' is not"),
        ({"remap_output": "cube"}, "remap_output 'cube' is not"),
        ({"neck": {"dim_in": [1, 2]}}, "neck: dim_in has 2 levels, expected 5"),
    ],
)
def test_what_is_not_supported_names_version_and_entry(
    change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    config = moge2_config()
    for key, value in change.items():
        config[key] = {**config[key], **value} if isinstance(value, dict) else value
    torch.save({"model_config": config, "model": {}}, tmp_path / "model.pt")
    with pytest.raises(CheckpointError) as caught:
        load_model(tmp_path / "model.pt")
    assert "model.pt is MoGe v2" in str(caught.value)
    assert message in str(caught.value)


def test_a_norm_that_is_left_out_is_the_official_default(tmp_path: Path) -> None:
    config = moge2_config()
    del config["neck"]["res_block_in_norm"]
    torch.save({"model_config": config, "model": {}}, tmp_path / "model.pt")
    with pytest.raises(CheckpointError, match="res_block_in_norm 'layer_norm' is not supported"):
        load_model(tmp_path / "model.pt")


def test_a_renamed_key_is_named(tmp_path: Path) -> None:
    made = small_moge2()
    weights = dict(made.state_dict())
    weights["neck.input_blocks.0.wieght"] = weights.pop("neck.input_blocks.0.weight")
    torch.save({"model_config": moge2_config(), "model": weights}, tmp_path / "model.pt")
    with pytest.raises(CheckpointError, match=r"missing: neck\.input_blocks\.0\.weight"):
        load_model(tmp_path / "model.pt")
