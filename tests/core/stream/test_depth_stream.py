"""DepthStream: causal, deterministic, resets with reasons, steady focal and shift."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from dyfn_core.geometry.camera import normalize_intrinsics
from dyfn_core.models.moge import MoGeModel
from dyfn_core.prediction import Prediction, StreamState
from dyfn_core.stream.depth_stream import DepthStream, MeanState, RobustMean, push_together
from dyfn_core.stream.resets import BACKWARDS, GAP, TimeRules
from tests.support.pinhole import FOV_X, PinholeModel, picture

FOCAL = 32 / np.tan(np.radians(FOV_X / 2))
CAMERA = np.array([[FOCAL, 0, 31.5], [0, FOCAL, 23.5], [0, 0, 1]])


def clip(count: int = 6, shift: float = 0.2, jitter: float = 0.0) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [picture(seed, shift + rng.normal(0, jitter)) for seed in range(count)]


def truth(image: np.ndarray) -> np.ndarray:
    return image[..., 0] / 255 + 0.5


def equal(one: Prediction, other: Prediction) -> bool:
    return all(
        torch.equal(getattr(one, name), getattr(other, name))
        for name in ("points", "depth", "mask", "intrinsics")
    )


def noise(seed: int, *size: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_scene_comes_out_as_it_is(pinhole: PinholeModel, camera: np.ndarray | None) -> None:
    stream = DepthStream(pinhole, camera)
    for image in clip():
        prediction = stream.push(image)
        np.testing.assert_allclose(prediction.depth.numpy(), truth(image), rtol=1e-3)
        np.testing.assert_allclose(
            prediction.intrinsics.numpy(), normalize_intrinsics(CAMERA, (48, 64)), atol=1e-3
        )


def test_same_frames_after_reset_give_the_same_bytes(small_moge: MoGeModel) -> None:
    stream = DepthStream(small_moge)
    frames = [noise(seed, 50, 60) for seed in range(4)]
    first = [stream.push(frame) for frame in frames]
    stream.reset()
    assert all(equal(a, stream.push(frame)) for a, frame in zip(first, frames, strict=True))
    fresh = DepthStream(small_moge)
    assert all(equal(a, fresh.push(frame)) for a, frame in zip(first, frames, strict=True))
    assert stream.resets == {"requested": 1}


def test_nothing_looks_ahead(small_moge: MoGeModel) -> None:
    frames = [noise(seed, 50, 60) for seed in range(4)]
    whole, part = DepthStream(small_moge), DepthStream(small_moge)
    early = [whole.push(frame) for frame in frames][:2]
    assert all(equal(a, part.push(f)) for a, f in zip(early, frames[:2], strict=True))


def test_stream_carries_the_models_state(small_moge: MoGeModel) -> None:
    stream, state = DepthStream(small_moge), None
    for seed in range(3):
        prediction = stream.push(noise(seed, 50, 60))
        state = small_moge.infer(noise(seed, 50, 60), state).state
        assert torch.equal(prediction.state.hidden, state.hidden)


def test_stabilizer_off_is_the_base_model_on_every_frame(small_moge: MoGeModel) -> None:
    stream = DepthStream(small_moge, CAMERA, stabilize=False)
    for seed in range(3):
        frame = noise(seed, 48, 64)
        prediction = stream.push(frame)
        assert prediction.state is None
        base = small_moge.infer(frame, stabilize=False, fov_x=FOV_X)
        assert torch.equal(prediction.mask, base.mask)
        torch.testing.assert_close(prediction.depth, base.depth, rtol=1e-5, atol=1e-6)


def test_known_camera_is_used_as_given(pinhole: PinholeModel) -> None:
    off_centre = CAMERA + np.array([[0, 0, 4.0], [0, 3.0, -2.5], [0, 0, 0]])
    prediction = DepthStream(pinhole, off_centre).push(picture())
    np.testing.assert_allclose(
        prediction.intrinsics.numpy(), normalize_intrinsics(off_centre, (48, 64)), rtol=1e-6
    )
    pixels = prediction.points.double().numpy() @ off_centre.T
    v, u = np.mgrid[:48, :64]
    np.testing.assert_allclose(pixels[..., 0] / pixels[..., 2], u, atol=1e-3)
    np.testing.assert_allclose(pixels[..., 1] / pixels[..., 2], v, atol=1e-3)


def test_new_camera_matrix_resets_and_the_same_one_does_not(pinhole: PinholeModel) -> None:
    stream = DepthStream(pinhole)
    stream.camera_matrix = CAMERA * [[2], [2], [1]]
    assert not stream.resets  # nothing had been seen yet
    stream.push(picture())
    stream.camera_matrix = CAMERA
    assert stream.resets == {"intrinsics changed": 1}
    stream.push(picture())
    stream.camera_matrix = CAMERA.copy()
    assert stream.memory.frames == 1
    stream.camera_matrix = None
    assert stream.resets == {"intrinsics changed": 2}
    assert stream.camera_matrix is None


def test_new_image_size_resets_and_forgets_the_camera(
    pinhole: PinholeModel, caplog: pytest.LogCaptureFixture
) -> None:
    stream = DepthStream(pinhole, CAMERA)
    stream.push(picture())
    larger = picture(size=(60, 80))
    prediction = stream.push(larger)
    assert stream.resets == {"image size changed": 1}
    assert stream.camera_matrix is None and "forgetting" in caplog.text
    assert equal(prediction, DepthStream(pinhole).push(larger))


def test_stamps_that_jump_reset_the_stream_and_say_so(small_moge: MoGeModel) -> None:
    stream = DepthStream(small_moge)
    frames = [noise(seed, 50, 60) for seed in range(4)]
    stamps = (0.0, 0.1, -1e6, -1e6 + 60)
    found = [stream.push(frame, stamp) for frame, stamp in zip(frames, stamps, strict=True)]
    assert [one.reset for one in found] == [None, None, BACKWARDS, GAP]
    assert stream.resets == {BACKWARDS: 1, GAP: 1}
    assert equal(found[2], DepthStream(small_moge).push(frames[2]))
    assert not equal(found[1], DepthStream(small_moge).push(frames[1]))


def test_rules_of_ones_own_and_frames_without_stamps_go_on(pinhole: PinholeModel) -> None:
    patient = DepthStream(pinhole, rules=TimeRules(tolerance=10.0, max_gap=0.0))
    for stamp in (0.0, 1e6, 1e6 - 9):
        patient.push(picture(), stamp)
    blind = DepthStream(pinhole)
    for _ in range(3):
        blind.push(picture())
    assert patient.memory.frames == blind.memory.frames == 3
    assert not patient.resets and not blind.resets


def test_a_batch_obeys_each_stream_s_own_stamps(pinhole: PinholeModel) -> None:
    streams = [DepthStream(pinhole), DepthStream(pinhole)]
    push_together(streams, [picture(), picture()], [0.0, 0.0])
    found = push_together(streams, [picture(), picture()], [0.1, 60.0])
    assert [one.reset for one in found] == [None, GAP]
    assert [stream.memory.frames for stream in streams] == [2, 1]


def test_intrinsics_come_in_pixels(pinhole: PinholeModel) -> None:
    known = DepthStream(pinhole, CAMERA).push(picture())
    np.testing.assert_array_equal(known.camera_matrix, CAMERA)
    found = DepthStream(pinhole).push(picture())
    np.testing.assert_allclose(found.camera_matrix, CAMERA, rtol=1e-3)
    arrays = found.numpy()
    np.testing.assert_array_equal(arrays.camera_matrix, found.camera_matrix)
    np.testing.assert_array_equal(arrays.valid, found.valid.numpy())


@pytest.mark.parametrize(
    ("image", "stamp", "error"),
    [
        (np.zeros((0, 5, 3), np.uint8), None, ValueError),
        (np.zeros((5, 5), np.uint8), None, ValueError),
        (np.zeros((2, 5, 5, 3), np.uint8), None, ValueError),
        (np.zeros((5, 5, 3), np.int64), None, TypeError),
        ([[0]], None, TypeError),
        (picture(3), float("nan"), ValueError),
    ],
)
def test_bad_frame_is_refused_and_changes_nothing(
    pinhole_with_dyfn: PinholeModel, image: object, stamp: float | None, error: type[Exception]
) -> None:
    stream = DepthStream(pinhole_with_dyfn)
    stream.push(picture(0), 1.0)
    before = stream.memory
    with pytest.raises(error):
        stream.push(image, stamp)
    assert stream.memory is before
    other = DepthStream(pinhole_with_dyfn)
    other.push(picture(0))
    assert equal(stream.push(picture(1)), other.push(picture(1)))


@pytest.mark.parametrize(
    "options", [{"shift_mode": "median"}, {"num_tokens": 0}, {"camera_matrix": np.zeros((3, 3))}]
)
def test_bad_options_are_refused(pinhole: PinholeModel, options: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(options)).replace("_", ".")):
        DepthStream(pinhole, **options)


def shifts(model: PinholeModel, mode: str, frames: list[np.ndarray]) -> np.ndarray:
    """What the stream added to the model's z, per frame."""
    stream = DepthStream(model, CAMERA, shift_mode=mode)
    return np.array(
        [
            float((stream.push(image).depth.numpy() - (truth(image) - image[0, 0, 1] / 255)).mean())
            for image in frames
        ]
    )


def test_filtered_shift_is_steadier_than_per_frame(pinhole: PinholeModel) -> None:
    frames = clip(30, shift=0.3, jitter=0.05)
    raw = shifts(pinhole, "per_frame", frames)
    filtered = shifts(pinhole, "filtered", frames)
    held = shifts(pinhole, "held", frames)
    assert np.abs(np.diff(filtered)).max() < 0.5 * np.abs(np.diff(raw)).max()
    assert abs(filtered[-1] - 0.3) < 0.03
    assert np.ptp(held) < 1e-5
    np.testing.assert_allclose(held, raw[0], atol=1e-5)


def test_default_shift_mode_follows_the_stabilizer(
    pinhole: PinholeModel, pinhole_with_dyfn: PinholeModel
) -> None:
    assert DepthStream(pinhole).shift_mode == "per_frame"
    assert DepthStream(pinhole_with_dyfn).shift_mode == "filtered"
    assert DepthStream(pinhole_with_dyfn, stabilize=False).shift_mode == "per_frame"


def test_held_shift_never_puts_much_of_a_frame_behind_the_camera(pinhole: PinholeModel) -> None:
    stream = DepthStream(pinhole, CAMERA, shift_mode="held")
    image = picture(0, shift=0.0)
    far = image.copy()
    far[..., 0] = np.clip(image[..., 0].astype(int) + 90, 0, 255)
    stream.push(far)
    stream.memory = replace(stream.memory, shift=MeanState(-1.0))
    prediction = stream.push(image)
    assert prediction.mask.float().mean() > 0.9
    assert (prediction.depth[prediction.mask] > 0).all()


def test_unknown_focal_settles(pinhole: PinholeModel) -> None:
    rng = np.random.default_rng(0)
    stream, fields = DepthStream(pinhole), []
    for seed in range(20):
        image = picture(seed)
        image[..., 0] = np.clip(image[..., 0] + rng.normal(0, 30, image.shape[:2]), 1, 255)
        fields.append(stream.push(image).intrinsics[0, 0].item())
    assert np.ptp(fields[-5:]) < 0.01
    assert fields[-1] == pytest.approx(FOCAL / 64, rel=0.02)


def test_frame_without_a_valid_pixel_keeps_the_camera(pinhole: PinholeModel) -> None:
    stream = DepthStream(pinhole, shift_mode="filtered")
    before = stream.push(picture(0, 0.2))
    black = picture(1, 0.2)
    black[..., 2] = 255
    prediction = stream.push(black)
    assert not prediction.mask.any()
    assert torch.equal(prediction.intrinsics, before.intrinsics)
    assert stream.memory.shift.count == 1


def test_memory_is_plain_and_restores(small_moge: MoGeModel) -> None:
    stream = DepthStream(small_moge)
    stream.push(noise(0, 50, 60), 0.5)
    saved = pickle.dumps(stream.memory)
    assert stream.memory.stamp == 0.5 and stream.memory.image_size == (50, 60)
    expected = stream.push(noise(1, 50, 60))
    other = DepthStream(small_moge)
    other.memory = pickle.loads(saved)
    assert equal(other.push(noise(1, 50, 60)), expected)


def test_streams_in_one_batch_equal_streams_alone(small_moge: MoGeModel) -> None:
    frames = [[noise(10 * camera + t, 50, 60) for camera in range(2)] for t in range(3)]
    together = [DepthStream(small_moge), DepthStream(small_moge)]
    alone = [DepthStream(small_moge), DepthStream(small_moge)]
    alone[1].push(noise(99, 50, 60))
    together[1].push(noise(99, 50, 60))
    for pair in frames:
        batch = push_together(together, pair, [1.0, 2.0])
        for got, stream, image in zip(batch, alone, pair, strict=True):
            want = stream.push(image)
            finite = got.mask & want.mask
            torch.testing.assert_close(got.depth[finite], want.depth[finite], rtol=2e-3, atol=1e-4)


def test_batch_of_streams_that_do_not_fit_is_refused(
    pinhole: PinholeModel, pinhole_with_dyfn: PinholeModel
) -> None:
    one, two = DepthStream(pinhole), DepthStream(pinhole_with_dyfn)
    with pytest.raises(ValueError, match="must share"):
        push_together([one, two], [picture(), picture()])
    with pytest.raises(ValueError, match="two frames"):
        push_together([one, one], [picture(), picture()])
    other = DepthStream(pinhole)
    with pytest.raises(ValueError, match="one size"):
        push_together([one, other], [picture(), picture(size=(40, 40))])
    assert one.memory.frames == other.memory.frames == 0


def test_states_of_different_shapes_make_no_batch() -> None:
    states = [StreamState(torch.zeros(1, 2, 3, 4)), StreamState(torch.zeros(1, 2, 4, 4))]
    with pytest.raises(ValueError, match="different shapes"):
        StreamState.stack(states)
    assert StreamState.stack([None, None]) is None


def test_robust_mean_is_the_mean_then_follows_and_resists_outliers() -> None:
    mean, track = RobustMean(gain=0.1, clip=3.0), None
    rng = np.random.default_rng(0)
    values = rng.normal(5.0, 0.1, 10)
    for value in values:
        track = mean.update(track, value)
    assert track.value == pytest.approx(values.mean(), abs=0.05)
    struck = mean.update(track, 50.0)
    assert abs(struck.value - track.value) < 0.1
    for _ in range(120):
        track = mean.update(track, 7.0)
    assert track.value == pytest.approx(7.0, abs=0.1)
