"""The same bits on any number of threads, alone and in a batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import load_model
from dyfn_core.models.deterministic import (
    DeterministicConv2d,
    DeterministicGroupNorm,
    DeterministicLinear,
    resize,
)
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.moge import MoGeModel
from dyfn_core.stream.depth_stream import DepthStream, push_together
from tests.support.seeded import normal

THREADS = (1, 2, 4)
MOGE = {
    "encoder": "dinov2_vits14",
    "intermediate_layers": 1,
    "dim_proj": 32,
    "dim_upsample": [32, 32, 32],
    "num_tokens_range": [20, 20],
}


@pytest.fixture(scope="module")
def mini() -> GeometryModel:
    return load_model("dyfn-mini")


def moge() -> MoGeModel:
    torch.manual_seed(0)
    model = MoGeModel.from_config(MOGE)
    model.stabilizer = build_dyfn(model.latent_channels, DyFNConfig(hidden=16))
    return model.eval()


def frames(count: int, height: int, width: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    small = rng.integers(0, 256, (count, height // 20, width // 20, 3), dtype=np.uint8)
    return list(small.repeat(20, axis=1).repeat(20, axis=2))


def pushed(model: GeometryModel, images: list[np.ndarray], tokens: int | None) -> list[bytes]:
    stream = DepthStream(model, num_tokens=tokens)
    predictions = [stream.push(image) for image in images]
    return [p.depth.numpy().tobytes() + p.points.numpy().tobytes() for p in predictions]


# 24 tokens at 120 x 160: feature maps so small that torch leaves oneDNN for one image.
@pytest.mark.slow
@pytest.mark.parametrize(("size", "tokens"), [((240, 320), None), ((120, 160), 24)])
def test_the_bundled_model_on_any_number_of_threads(
    mini: GeometryModel, size: tuple[int, int], tokens: int | None
) -> None:
    images, results = frames(2, *size), []
    for threads in THREADS:
        torch.set_num_threads(threads)
        results.append(pushed(mini, images, tokens))
    assert results[0] == results[1] == results[2]
    assert results[0][0] != results[0][1]


@pytest.mark.slow
def test_moge_on_any_number_of_threads() -> None:
    model, images, results = moge(), frames(2, 100, 140), []
    for threads in THREADS:
        torch.set_num_threads(threads)
        results.append(pushed(model, images, 20))
    assert results[0] == results[1] == results[2]


@pytest.mark.slow
def test_a_camera_in_a_batch_gives_what_it_gives_alone(mini: GeometryModel) -> None:
    torch.set_num_threads(2)
    images = frames(4, 120, 160)
    streams = [DepthStream(mini, num_tokens=24) for _ in range(2)]
    together = [push_together(streams, images[i : i + 2]) for i in (0, 2)]
    for camera in range(2):
        alone = pushed(mini, images[camera::2], 24)
        batch = [group[camera] for group in together]
        assert alone == [p.depth.numpy().tobytes() + p.points.numpy().tobytes() for p in batch]


@pytest.mark.parametrize(
    "settings",
    [
        {"kernel_size": 1},
        {"kernel_size": 1, "bias": False},
        {"kernel_size": 3, "padding": 1},
        {"kernel_size": 3, "padding": 1, "padding_mode": "replicate"},
        {"kernel_size": 2, "stride": 2},
        {"kernel_size": 3, "padding": 1, "groups": 4},
    ],
)
@pytest.mark.parametrize("shape", [(2, 8, 6, 5), (2, 8, 3, 3)])
def test_convolutions_and_their_gradients_are_those_of_torch(
    settings: dict, shape: tuple[int, ...]
) -> None:
    torch.manual_seed(0)
    ours, theirs = DeterministicConv2d(8, 12, **settings), nn.Conv2d(8, 12, **settings)
    theirs.load_state_dict(ours.state_dict())
    _compare(ours, theirs, normal(0, *shape))


def test_a_convolution_of_one_cell_is_that_of_torch() -> None:
    ours, theirs = DeterministicConv2d(8, 12, 1), nn.Conv2d(8, 12, 1)
    theirs.load_state_dict(ours.state_dict())
    _compare(ours, theirs, normal(0, 3, 8, 1, 1))


@pytest.mark.parametrize("shape", [(2, 7, 8), (3, 8), (1, 1, 8)])
def test_linear_layers_and_norms_are_those_of_torch(shape: tuple[int, ...]) -> None:
    ours, theirs = DeterministicLinear(8, 12), nn.Linear(8, 12)
    theirs.load_state_dict(ours.state_dict())
    _compare(ours, theirs, normal(0, *shape))
    pixels = normal(0, 2, 8, 6, 5).contiguous(memory_format=torch.channels_last)
    _compare(DeterministicGroupNorm(4, 8), nn.GroupNorm(4, 8), pixels)


def test_half_precision_is_left_to_torch() -> None:
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert DeterministicConv2d(8, 4, 1)(normal(0, 1, 8, 3, 3)).dtype == torch.bfloat16
        assert DeterministicLinear(8, 4)(normal(0, 1, 3, 8)).dtype == torch.bfloat16
    assert (
        DeterministicConv2d(8, 4, 1).double()(normal(0, 1, 8, 3, 3).double()).dtype == torch.float64
    )


@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("align_corners", [False, True])
def test_resizing_is_that_of_torch(channels: int, align_corners: bool) -> None:
    x = normal(0, 2, channels, 9, 7)
    theirs = nn.functional.interpolate(x, (31, 22), mode="bilinear", align_corners=align_corners)
    torch.testing.assert_close(resize(x, (31, 22), align_corners), theirs)
    assert resize(x, (9, 7)) is x


def _compare(ours: nn.Module, theirs: nn.Module, x: Tensor) -> None:
    results = []
    for module in (ours, theirs):
        source = x.detach().clone().requires_grad_()
        out = module(source)
        out.square().sum().backward()
        gradients = [p.grad for p in module.parameters()]
        results.append((out, source.grad, gradients))
    torch.testing.assert_close(results[0], results[1])
