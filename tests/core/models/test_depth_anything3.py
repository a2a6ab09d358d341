"""Depth Anything 3, mono and metric: equal to the official code, honest about scale and shift."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from dyfn_core.models.checkpoints import CheckpointError, load_model, save_model
from dyfn_core.models.depth_anything3 import (
    DepthAnything3Config,
    DepthAnything3Model,
    official_kind,
)
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.stream.depth_stream import DepthStream
from tests.support.bases import small_da3
from tests.support.golden2 import Golden2, batch_of, close

CASE = "f0_320x240_res252"


@pytest.fixture(scope="module")
def model(golden2: Golden2) -> DepthAnything3Model:
    config = DepthAnything3Config("metric", encoder="dinov2_vits14", process_size=252)
    made = DepthAnything3Model(config).eval()
    made.load_state_dict(golden2.weights("da3mono_small"), assign=True)
    return made


@pytest.mark.parametrize("case", [CASE, "f0_317x203_res252"])
@torch.inference_mode()
def test_network_matches_the_official_one(
    golden2: Golden2, model: DepthAnything3Model, case: str
) -> None:
    wanted = golden2.arrays("da3mono_small", case)
    image = torch.from_numpy(wanted["network_input_u8"])
    size = (image.shape[1], image.shape[2])
    latent = model.encode_prepared(model.normalised(image, size))
    fused = torch.nn.functional.interpolate(
        latent.features, scale_factor=2, mode="bilinear", align_corners=True
    )
    close(fused[0, ::2, ::6, ::6], wanted["refinenet1"])
    close(fused[0].mean((1, 2)), wanted["refinenet1_channel_mean"])
    affine = model.decode(latent)
    step = -(-size[0] // wanted["depth"].shape[1])
    close(affine.depth[:, ::step, ::step], wanted["depth"], rtol=1e-4)
    sky = 0.3 - affine.mask[:, ::step, ::step]
    close(sky, wanted["sky"])
    focal = torch.tensor([[[280 / size[1], 0, 0.5], [0, 290 / size[0], 0.5], [0, 0, 1]]])
    scale = affine.metric_scale(focal)
    assert scale is not None
    metres = (affine.depth * scale[:, None, None])[:, ::step, ::step]
    close(metres, wanted["metric_depth_fx280_fy290"], rtol=1e-4)


@pytest.mark.parametrize(("case", "size"), [(CASE, (240, 320)), ("f0_317x203_res252", (203, 317))])
@torch.inference_mode()
def test_images_are_prepared_as_officially(
    golden2: Golden2, model: DepthAnything3Model, case: str, size: tuple[int, int]
) -> None:
    wanted = golden2.arrays("da3mono_small", case)
    latent = model.encode(batch_of(golden2.frame(0, size)))
    assert latent.network_size == tuple(wanted["network_hw"].tolist())
    shown = torch.from_numpy(wanted["network_input_u8"])
    exact = model.encode_prepared(model.normalised(shown, size))
    # Another release of OpenCV may round a few pixels to the next of 256 levels.
    torch.testing.assert_close(latent.features, exact.features, rtol=0, atol=0.05)


def test_images_of_a_batch_do_not_share_their_sky(
    golden2: Golden2, model: DepthAnything3Model
) -> None:
    """Officially one quantile for the batch; a stream must not depend on another camera."""
    images = np.stack([golden2.frame(0), golden2.frame(4)])
    together = model.infer(images, apply_mask=False)
    for index, image in enumerate(images):
        alone = model.infer(image, apply_mask=False)
        torch.testing.assert_close(alone.depth, together.depth[index])


@pytest.mark.parametrize("name", ["da3mono_small", "da3mono_large"])
def test_names_and_shapes_are_the_released_ones(golden2: Golden2, name: str) -> None:
    spec = golden2.spec(name)
    encoder = {"da3mono_small": "dinov2_vits14", "da3mono_large": "dinov2_vitl14"}[name]
    with torch.device("meta"):
        made = DepthAnything3Model(DepthAnything3Config("mono", encoder=encoder))
    found = {key: list(value.shape) for key, value in made.state_dict().items()}
    assert found == {key: value["shape"] for key, value in spec["keys"].items()}


@pytest.mark.slow
@torch.inference_mode()
def test_released_shape_matches(golden2: Golden2) -> None:
    if not os.environ.get("DYFN_LARGE"):
        pytest.skip("set DYFN_LARGE=1 to make 1.3 GB of weights (a minute)")
    made = DepthAnything3Model(DepthAnything3Config("mono", process_size=252)).eval()
    made.load_state_dict(golden2.weights("da3mono_large"), assign=True)
    wanted = golden2.arrays("da3mono_large", CASE)
    image = torch.from_numpy(wanted["network_input_u8"])
    affine = made.decode(
        made.encode_prepared(made.normalised(image, (image.shape[1], image.shape[2])))
    )
    close(affine.depth[:, ::4, ::4], wanted["depth"], rtol=1e-4)
    close(0.3 - affine.mask[:, ::4, ::4], wanted["sky"])


def test_official_file_is_read_by_what_its_config_says(golden2: Golden2, tmp_path: Path) -> None:
    weights = golden2.da3_file("da3mono_small", tmp_path, {"model_name": "da3metric-large"})
    assert load_model(weights).config["kind"] == "metric"
    (tmp_path / "config.json").unlink()
    with pytest.raises(CheckpointError, match="says whether mono or metric"):
        load_model(weights)
    named = tmp_path / "depth-anything" / "DA3MONO-LARGE"
    named.mkdir(parents=True)
    weights.rename(named / "model.safetensors")
    loaded = load_model(named / "model.safetensors")
    assert loaded.config["kind"] == "mono"
    assert loaded.quantity == "affine_depth"


# Without the golden files.


def picture(seed: int = 0, size: tuple[int, int] = (60, 80)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (*size, 3)).astype(np.uint8)


def test_mono_knows_neither_scale_nor_shift() -> None:
    made = small_da3("mono")
    for found in (made.infer(picture(), fov_x=60.0), made.infer(picture())):
        assert found.quantity == "affine_depth"
        assert not found.metric
        assert 0 < float(found.mask.float().mean()) < 1  # some sky


def test_metric_needs_the_focal_length() -> None:
    made = small_da3("metric")
    unknown, wide, narrow = (made.infer(picture(), fov_x=fov) for fov in (None, 90.0, 53.13010235))
    assert not unknown.metric
    assert wide.metric
    assert narrow.metric
    # Half the width over tan(45 deg) against twice that.
    torch.testing.assert_close(narrow.depth, 2 * wide.depth)
    pixels = 0.5 * 56  # focal length of the wide camera at the network's width
    torch.testing.assert_close(wide.depth, unknown.depth * pixels / 300, rtol=0.03, atol=0)


def test_sky_is_no_valid_pixel_and_far() -> None:
    made = small_da3("mono")
    found, seen = made.infer(picture()), made.infer(picture(), apply_mask=False)
    assert bool(torch.isinf(found.depth[~found.mask]).all())
    rest = seen.depth[seen.mask]
    assert float(seen.depth[~seen.mask].median()) >= float(rest.quantile(0.9))


def test_stream_keeps_the_models_unit() -> None:
    made = small_da3("mono")
    stream = DepthStream(made, np.array([[80.0, 0, 39.5], [0, 80.0, 29.5], [0, 0, 1]]))
    for seed in range(2):
        found = stream.push(picture(seed))
        alone = made.infer(picture(seed))
        torch.testing.assert_close(found.depth, alone.depth)
        assert float(found.intrinsics[0, 0]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("size", "sizes"),
    [((240, 320), (378, 504)), ((203, 317), (322, 504)), ((320, 240), (504, 378))],
)
def test_network_size_is_the_official_one(size: tuple[int, int], sizes: tuple[int, int]) -> None:
    with torch.device("meta"):
        made = DepthAnything3Model(DepthAnything3Config("mono"))
    assert made.network_sizes(size, None)[-1] == sizes


def test_our_format_keeps_model_and_stabilizer(tmp_path: Path) -> None:
    made = small_da3("metric")
    made.stabilizer = build_dyfn(made.latent_channels, DyFNConfig(hidden=8, pool=4))
    save_model(made, tmp_path / "model.safetensors")
    loaded = load_model(tmp_path / "model.safetensors")
    assert loaded.config == made.config
    assert torch.equal(loaded.infer(picture()).depth, made.infer(picture()).depth)


@pytest.mark.parametrize(
    ("names", "kind"),
    [
        (["da3metric-large"], "metric"),
        (["x", "models--depth-anything--DA3MONO-LARGE"], "mono"),
        (["da3mono", "da3metric"], None),
        (["da3-large"], None),
    ],
)
def test_names_that_say_which_it_is(names: list[str], kind: str | None) -> None:
    assert official_kind(names) == kind


@pytest.mark.parametrize("extra", ["model.cam_dec.fc.weight", "model.da3.backbone.pretrained.x"])
def test_models_for_several_views_are_refused_by_name(extra: str, tmp_path: Path) -> None:
    start = torch.zeros(1, 1, 384)
    weights = {"model.backbone.pretrained.cls_token": start, extra: torch.zeros(1)}
    save_file(weights, tmp_path / "model.safetensors")
    with pytest.raises(CheckpointError) as caught:
        load_model(tmp_path / "model.safetensors")
    assert "Depth Anything 3 for several views" in str(caught.value)
    assert "supported are DA3MONO-LARGE and DA3METRIC-LARGE" in str(caught.value)
