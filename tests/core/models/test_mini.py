"""The small model: its encoder's weights, sizes, invariances and checkpoint."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from dyfn_core.models import checkpoints
from dyfn_core.models.checkpoints import load_model, save_model
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.efficientnet import BATCH_NORM_EPS, EfficientNetLite0, imagenet_weights
from dyfn_core.models.mini import MiniConfig, MiniModel, remap_exp
from tests.support.seeded import normal, uniform

SMALL = MiniConfig(latent_channels=16, stage_channels=(16, 8), context_channels=24)


@pytest.fixture(scope="module")
def weights() -> dict[str, Tensor]:
    return imagenet_weights()


@pytest.fixture(scope="module")
def model() -> MiniModel:
    torch.manual_seed(0)
    return MiniModel(SMALL).eval()


def reference_start(image: Tensor, weights: dict[str, Tensor]) -> Tensor:
    """Stem and first block written out with batch normalisation as TensorFlow pads it."""

    def norm(x: Tensor, name: str) -> Tensor:
        parts = (weights[f"{name}.{p}"] for p in ("running_mean", "running_var", "weight", "bias"))
        return F.batch_norm(x, *parts, False, 0.0, BATCH_NORM_EPS)

    x = F.conv2d(F.pad(image, (0, 1, 0, 1)), weights["_conv_stem.weight"], stride=2)
    x = F.relu6(norm(x, "_bn0"))
    x = F.conv2d(x, weights["_blocks.0._depthwise_conv.weight"], padding=1, groups=32)
    x = F.relu6(norm(x, "_blocks.0._bn1"))
    return norm(F.conv2d(x, weights["_blocks.0._project_conv.weight"]), "_blocks.0._bn2")


def test_encoder_computes_what_the_classifier_with_batch_normalisation_does(
    weights: dict[str, Tensor],
) -> None:
    encoder = EfficientNetLite0(folded=False)
    encoder.load_imagenet(weights)
    image = normal(0, 1, 3, 32, 64)
    ours = encoder.blocks[0](F.relu6(encoder.stem(image)))
    torch.testing.assert_close(ours, reference_start(image, weights), rtol=1e-4, atol=1e-4)


def test_pretrained_features_fit_the_running_statistics(weights: dict[str, Tensor]) -> None:
    """On smooth images in the right normalisation no layer is far from what it was trained on."""
    encoder = EfficientNetLite0(folded=False)
    encoder.load_imagenet(weights)
    image = F.interpolate(uniform(0, 4, 3, 6, 6), size=(128, 128), mode="bicubic") * 2 - 1
    for feature in encoder(image):
        assert 0.5 < float(feature.detach().std()) < 20


def test_encoder_lists_keys_that_are_missing_and_unexpected(weights: dict[str, Tensor]) -> None:
    changed = dict(weights)
    del changed["_blocks.3._bn1.bias"]
    changed["extra"] = torch.zeros(1)
    with pytest.raises(ValueError, match=r"_blocks\.3\._bn1\.bias.*extra"):
        EfficientNetLite0(folded=False).load_imagenet(changed)


def test_folding_the_normalisation_changes_nothing(weights: dict[str, Tensor]) -> None:
    model = MiniModel(MiniConfig(folded=False)).eval()
    model.encoder.load_imagenet(weights)
    folded = model.folded()
    image = uniform(0, 1, 3, 64, 96)
    assert folded.settings.folded
    assert not [name for name, _ in folded.named_buffers()]
    torch.testing.assert_close(
        folded.encode_at(image, (64, 96)).features, model.encode_at(image, (64, 96)).features
    )


def test_frozen_parts_get_no_gradients_and_the_rest_does(model: MiniModel) -> None:
    model.encoder.frozen_blocks = 3
    try:
        model.encode_at(uniform(0, 1, 3, 64, 64), (64, 64)).features.sum().backward()
        got = {name for name, p in model.encoder.named_parameters() if p.grad is not None}
        assert not [name for name in got if name.startswith(("stem", "blocks.0.", "blocks.2."))]
        assert {"blocks.3.expand.weight", "blocks.15.project.bias"} <= got
    finally:
        model.encoder.frozen_blocks = 0
        model.zero_grad()


@pytest.mark.parametrize(
    ("image", "tokens", "network"),
    [
        ((240, 320), 300, (256, 320)),
        ((480, 640), 300, (256, 320)),
        ((320, 240), 80, (160, 128)),
        ((17, 1000), 300, (32, 2112)),
    ],
)
def test_network_size_keeps_the_budget_and_aspect(
    model: MiniModel, image: tuple[int, int], tokens: int, network: tuple[int, int]
) -> None:
    assert model.network_size(image, tokens) == network


@pytest.mark.parametrize("size", [(45, 61), (64, 96), (100, 31)])
def test_points_have_the_size_of_the_image(model: MiniModel, size: tuple[int, int]) -> None:
    with torch.no_grad():
        latent = model.encode(uniform(0, 2, 3, *size), num_tokens=24)
        decoded = model.decode(latent)
    assert latent.features.shape[-2] * 8 == latent.network_size[0]
    assert decoded.points.shape == (2, *size, 3)
    assert decoded.mask.shape == (2, *size)
    assert bool((decoded.points[..., 2] > 0).all())


def test_images_of_a_batch_do_not_see_each_other(model: MiniModel) -> None:
    images = uniform(0, 2, 3, 64, 64)
    with torch.no_grad():
        both = model.decode(model.encode(images)).points
        alone = model.decode(model.encode(images[1:])).points
    torch.testing.assert_close(both[1:], alone, rtol=1e-4, atol=1e-4)


def test_remap_makes_x_and_y_proportional_to_z() -> None:
    raw = torch.tensor([0.5, -2.0, 1.0]).view(1, 3, 1, 1)
    expected = torch.tensor([0.5, -2.0, 1.0]) * torch.tensor(1.0).exp()
    torch.testing.assert_close(remap_exp(raw).flatten(), expected)


def test_untrained_model_sees_a_plane_through_a_pinhole(model: MiniModel) -> None:
    """Its x / z grow with the column, its y / z with the row, whatever the image."""
    with torch.no_grad():
        points = model.decode(model.encode(uniform(0, 1, 3, 64, 96))).points[0]
    slopes = points[..., :2] / points[..., 2:]
    assert bool((slopes[:, 1:, 0] > slopes[:, :-1, 0]).float().mean() > 0.95)
    assert bool((slopes[1:, :, 1] > slopes[:-1, :, 1]).float().mean() > 0.95)


def test_checkpoint_brings_the_same_model_back(model: MiniModel, tmp_path: Path) -> None:
    torch.manual_seed(1)
    saved = MiniModel(SMALL).eval()
    saved.stabilizer = build_dyfn(16, DyFNConfig(hidden=4, pool=2, form="residual"))
    save_model(saved, tmp_path / "mini.safetensors")
    loaded = load_model(tmp_path / "mini.safetensors")
    image = uniform(0, 1, 3, 64, 96)
    with torch.no_grad():
        ours, state = saved.predict_affine(image)
        theirs, other = loaded.predict_affine(image)
    assert torch.equal(ours.points, theirs.points)
    assert state is not None
    assert other is not None
    assert torch.equal(state.hidden, other.hidden)


def test_bundled_versions_load_by_name() -> None:
    default, nine = (load_model(name) for name in ("dyfn-mini", "dyfn-mini-9"))
    pairs = zip(default.state_dict().values(), nine.state_dict().values(), strict=True)
    assert all(torch.equal(ours, theirs) for ours, theirs in pairs)
    image = uniform(0, 1, 3, 96, 128)
    depths = [default.infer(image).depth]
    for name in ("dyfn-mini-5", "dyfn-mini-6", "dyfn-mini-7", "dyfn-mini-8"):
        model = load_model(name)
        assert model.stabilizer is not None
        assert {value.dtype for value in model.parameters()} == {torch.float32}
        depth = model.infer(image).depth
        assert torch.isfinite(depth).any()
        assert not any(torch.equal(depth, other) for other in depths)
        depths.append(depth)


def test_every_bundled_file_is_checked_when_it_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert set(checkpoints.BUNDLED.values()) == set(checkpoints.BUNDLED_SHA256)
    folder = tmp_path / "weights"
    folder.mkdir()
    whole = (files("dyfn_core") / "weights" / checkpoints.BUNDLED["dyfn-mini-7"]).read_bytes()
    flipped = bytearray(whole)
    flipped[-1] ^= 1
    (folder / checkpoints.BUNDLED["dyfn-mini-7"]).write_bytes(flipped)
    monkeypatch.setattr(checkpoints, "files", lambda _: tmp_path)
    with pytest.raises(checkpoints.CheckpointError, match="damaged: its SHA-256"):
        load_model("dyfn-mini-7")


def test_weights_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    model = load_model("dyfn-mini-7")
    name, value = next(iter(model.named_parameters()))
    with torch.no_grad():
        value.view(-1)[3] = torch.inf
    save_model(model, tmp_path / "m.safetensors")
    with pytest.raises(checkpoints.CheckpointError, match=f"not finite: {name}"):
        load_model(tmp_path / "m.safetensors")
