"""GeometryModel.infer: what goes in, what comes out, the stabilizer's switch."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np
import pytest
import torch

from dyfn_core.models.moge import MoGeModel, resized, whole_patches
from dyfn_core.prediction import Prediction
from tests.support.pinhole import FOV_X, PinholeModel, picture


def noise(seed: int, *size: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)


def same(one: Prediction, other: Prediction) -> bool:
    def agree(a: object, b: object) -> bool:
        both = isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor)
        return torch.equal(a, b) if both else a == b  # type: ignore[arg-type]

    return all(
        agree(getattr(one, field.name), getattr(other, field.name))
        for field in fields(Prediction)
        if field.name != "state"
    )


def field_of_view(prediction: Prediction) -> float:
    """Horizontal, in degrees."""
    return math.degrees(2 * math.atan(0.5 / prediction.intrinsics[0, 0].item()))


def test_pinhole_scene_comes_out_as_it_is(pinhole: PinholeModel) -> None:
    image = picture(shift=0.2)
    prediction = pinhole.infer(image)
    truth = image[..., 0] / 255 + 0.5
    assert field_of_view(prediction) == pytest.approx(FOV_X, abs=1e-3)
    np.testing.assert_allclose(prediction.depth.numpy(), truth, rtol=1e-4)
    own = pinhole.infer(image, force_projection=False)
    np.testing.assert_allclose(own.points.numpy(), prediction.points.numpy(), atol=1e-4)


def test_known_field_of_view_is_kept(pinhole: PinholeModel) -> None:
    prediction = pinhole.infer(picture(), fov_x=50.0)
    assert field_of_view(prediction) == pytest.approx(50, abs=1e-4)
    np.testing.assert_allclose(
        prediction.intrinsics[0, 0].item() * 64, prediction.intrinsics[1, 1].item() * 48, rtol=1e-6
    )


def test_types_and_shapes(pinhole: PinholeModel) -> None:
    prediction = pinhole.infer(picture())
    assert prediction.points.shape == (48, 64, 3)
    assert prediction.depth.shape == prediction.mask.shape == (48, 64)
    assert prediction.intrinsics.shape == (3, 3)
    assert prediction.points.dtype == prediction.depth.dtype == torch.float32
    assert prediction.intrinsics.dtype == torch.float32
    assert prediction.mask.dtype == torch.bool
    batch = pinhole.infer(np.stack([picture(0), picture(1)]))
    assert batch.points.shape == (2, 48, 64, 3)
    assert batch.intrinsics.shape == (2, 3, 3)


def test_image_formats_agree(pinhole: PinholeModel) -> None:
    image = picture()
    floats = torch.from_numpy(image).permute(2, 0, 1).float() / 255
    read_only = image.copy()
    read_only.flags.writeable = False
    for other in (
        floats,
        floats.numpy(),
        torch.from_numpy(image),
        read_only,
        image[:, ::-1][:, ::-1],
        floats.double(),
    ):
        assert same(pinhole.infer(image), pinhole.infer(other))


def test_masked_pixels_are_infinite(pinhole: PinholeModel) -> None:
    image = picture()
    image[:10, :, 2] = 255
    prediction = pinhole.infer(image)
    assert not prediction.mask[:10].any() and prediction.mask[10:].all()
    assert torch.isinf(prediction.depth[:10]).all() and torch.isinf(prediction.points[:10]).all()
    assert torch.isfinite(prediction.depth[10:]).all()
    bare = pinhole.infer(image, apply_mask=False)
    assert torch.isfinite(bare.depth).all() and torch.isfinite(bare.points).all()
    assert torch.equal(bare.mask, prediction.mask)


def test_a_point_behind_the_camera_is_not_valid(pinhole: PinholeModel) -> None:
    image = picture(size=(256, 256))
    image[1::4, 1::4, 0] = 0  # between the 64 x 64 samples, so the solver does not see them
    image[..., 1] = 0
    prediction = pinhole.infer(image, fov_x=20.0)
    assert (prediction.depth[prediction.mask] > 0).all()


def test_image_that_is_masked_out_gives_nothing_but_no_error(pinhole: PinholeModel) -> None:
    image = picture()
    image[..., 2] = 255
    prediction = pinhole.infer(image)
    assert not prediction.mask.any()
    assert torch.isfinite(prediction.intrinsics).all()


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        ("picture.png", TypeError, "numpy array or a torch tensor"),
        (np.zeros((4, 4, 3), np.uint16), TypeError, "uint16"),
        (torch.zeros(3, 4, 4, dtype=torch.int32), TypeError, "int32"),
        (np.zeros((4, 4), np.uint8), ValueError, "one image or a batch"),
        (np.zeros((4, 4, 4), np.uint8), ValueError, "H x W x 3"),
        (np.zeros((3, 4, 4), np.uint8), ValueError, "H x W x 3"),
        (np.zeros((0, 4, 3), np.uint8), ValueError, "empty"),
        (np.zeros((4, 4, 3), np.float32), ValueError, "3 x H x W"),
        (np.full((3, 4, 4), 128.0), ValueError, "0..1"),
        (np.full((3, 4, 4), math.nan), ValueError, "finite"),
    ],
)
def test_bad_image_is_refused(
    pinhole: PinholeModel, image: object, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        pinhole.infer(image)


def test_stabilizer_off_is_base_model_bit_for_bit(small_moge: MoGeModel) -> None:
    base = MoGeModel(small_moge.architecture).eval()
    base.load_state_dict(
        {k: v for k, v in small_moge.state_dict().items() if not k.startswith("stabilizer.")}
    )
    for seed, size in enumerate([(60, 80), (57, 91)]):
        image = noise(seed, *size)
        state = small_moge.infer(image).state
        off = small_moge.infer(image, state, stabilize=False)
        assert off.state is None
        assert same(off, base.infer(image))
        assert not same(off, small_moge.infer(image))


def test_stabilizer_off_runs_nothing_of_it(small_moge: MoGeModel) -> None:
    calls = []
    hook = small_moge.stabilizer.register_forward_pre_hook(lambda *_: calls.append(1))
    small_moge.infer(noise(0, 40, 40), stabilize=False)
    assert not calls
    small_moge.infer(noise(0, 40, 40))
    hook.remove()
    assert calls


def test_state_changes_what_follows_and_is_never_changed(small_moge: MoGeModel) -> None:
    first = small_moge.infer(noise(0, 40, 56))
    hidden = first.state.hidden.clone()
    with_state = small_moge.infer(noise(1, 40, 56), first.state)
    again = small_moge.infer(noise(1, 40, 56), first.state)
    assert same(with_state, again)
    assert torch.equal(first.state.hidden, hidden)
    assert not same(with_state, small_moge.infer(noise(1, 40, 56)))


@pytest.mark.parametrize("size", [(31, 97), (203, 61), (14, 14), (5, 200), (1, 1)])
def test_odd_sizes_come_out_at_their_size(small_moge: MoGeModel, size: tuple[int, int]) -> None:
    prediction = small_moge.infer(noise(0, *size))
    assert prediction.depth.shape == size
    assert prediction.points.shape == (*size, 3)
    again = small_moge.infer(noise(1, *size), prediction.state)
    assert again.depth.shape == size


def test_batch_equals_single_images(small_moge: MoGeModel) -> None:
    images = np.stack([noise(seed, 45, 70) for seed in range(3)])
    batch = small_moge.infer(images, apply_mask=False)
    second = small_moge.infer(images[::-1].copy(), batch.state, apply_mask=False)
    states = batch.state.unbind()
    for index in range(3):
        one = small_moge.infer(images[index], apply_mask=False)
        torch.testing.assert_close(batch.depth[index], one.depth, rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(states[index].hidden, one.state.hidden, rtol=1e-3, atol=1e-4)
        two = small_moge.infer(images[2 - index], one.state, apply_mask=False)
        torch.testing.assert_close(second.depth[index], two.depth, rtol=1e-3, atol=1e-4)


def test_network_size_follows_the_token_budget() -> None:
    assert resized((240, 320), 300) == (210, 280)
    assert whole_patches(resized((203, 317), 300)) == (182, 294)
    height, width = resized((480, 640), 1200)
    assert (height // 14) * (width // 14) <= 1200
    with pytest.raises(ValueError, match="num_tokens"):
        resized((10, 10), 0)
