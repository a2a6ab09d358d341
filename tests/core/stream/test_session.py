"""The frame worker, its log throttle, and a camera's stream: without ROS."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dyfn_core.geometry.camera import pixel_intrinsics
from dyfn_core.prediction import Prediction
from dyfn_core.stream.session import (
    BACKWARDS,
    FAILED,
    GAP,
    NEW_CAMERA,
    NEW_FRAME_ID,
    NEW_SETTINGS,
    NEW_SIZE,
    Geometry,
    StreamFrame,
    StreamHook,
    StreamKey,
    StreamSession,
    TimeRules,
)
from dyfn_ros.node.log_throttle import Throttle
from dyfn_ros.node.worker import FrameWorker

DEADLINE = 20.0


class Bench:
    """A worker whose work waits for a permit per batch."""

    def __init__(self, **options: Any) -> None:
        self.started = threading.Semaphore(0)
        self.permits = threading.Semaphore(0)
        self.finished = threading.Semaphore(0)
        self.done: list[list[int]] = []
        self.worker: FrameWorker[int] = FrameWorker(self._work, **options)
        self.worker.start()

    def _work(self, frames: list[int]) -> None:
        self.started.release()
        assert self.permits.acquire(timeout=DEADLINE)
        if min(frames) < 0:
            raise ValueError(f"frames {frames}")
        self.done.append(frames)
        self.finished.release()

    def begin(self, frame: int, source: int = 0) -> None:
        """Submit, and wait until the worker has taken it."""
        assert self.worker.submit(frame, source)
        assert self.started.acquire(timeout=DEADLINE)

    def let(self, count: int) -> None:
        self.permits.release(count)
        for _ in range(count):
            assert self.finished.acquire(timeout=DEADLINE)


def test_the_latest_frame_replaces_the_waiting_one() -> None:
    bench = Bench()
    bench.begin(1)
    assert all(bench.worker.submit(frame) for frame in (2, 3, 4))
    bench.let(2)
    assert bench.worker.stop(DEADLINE)
    assert (bench.done, bench.worker.dropped()) == ([[1], [4]], 2)


def test_a_queue_keeps_order_and_refuses_when_full() -> None:
    bench = Bench(keep_all=True, capacity=3)
    bench.begin(1)
    assert [bench.worker.submit(frame) for frame in (2, 3, 4, 5)] == [True, True, True, False]
    bench.let(4)
    bench.worker.stop(DEADLINE)
    assert (bench.done, bench.worker.dropped()) == ([[1], [2], [3], [4]], 1)


def test_what_waits_together_is_taken_together_one_of_each_source() -> None:
    bench = Bench(keep_all=True, capacity=9, held=[False] * 3)
    bench.begin(10, 0)
    for frame, source in ((20, 1), (21, 1), (11, 0)):
        bench.worker.submit(frame, source)
    bench.let(3)
    bench.worker.stop(DEADLINE)
    assert bench.done == [[10], [11, 20], [21]]


def test_sources_drop_and_hold_for_themselves() -> None:
    bench = Bench(held=[False, True])
    bench.begin(1, 0)
    bench.worker.submit(5, 1)
    bench.worker.submit(6, 1)
    bench.worker.submit(2, 0)
    bench.let(2)
    assert bench.done == [[1], [2]]
    bench.worker.release(1)
    bench.let(1)
    bench.worker.stop(DEADLINE)
    assert bench.done[2] == [6]
    assert [bench.worker.dropped(source) for source in (0, 1)] == [0, 1]


def test_discard_drops_what_waits_and_not_what_runs() -> None:
    bench = Bench(keep_all=True, capacity=9)
    bench.begin(1)
    bench.worker.submit(2)
    bench.worker.submit(3)
    assert bench.worker.discard() == 2
    bench.worker.submit(4)
    bench.let(2)
    bench.worker.stop(DEADLINE)
    assert (bench.done, bench.worker.dropped()) == ([[1], [4]], 2)


def test_stop_counts_what_waits_and_gives_up_on_endless_work() -> None:
    bench = Bench(keep_all=True, capacity=9)
    bench.begin(1)
    bench.worker.submit(2)
    assert not bench.worker.stop(patience=0.05)
    assert bench.worker.dropped() == 1
    bench.let(1)
    assert bench.worker.stop(DEADLINE)
    assert bench.done == [[1]]


def test_prepare_runs_first_and_its_failure_is_told() -> None:
    def prepare() -> None:
        raise OSError("no such model")

    worker: FrameWorker[int] = FrameWorker(lambda frames: None, prepare=prepare)
    assert not worker.wait_prepared(0.0)
    worker.start()
    assert worker.wait_prepared(DEADLINE)
    assert worker.stop(DEADLINE)
    assert str(worker.error) == "no such model"


def test_an_exception_in_work_ends_the_thread_and_is_told() -> None:
    bench = Bench()
    bench.begin(-1)
    bench.permits.release()
    assert bench.worker.stop(DEADLINE)
    assert str(bench.worker.error) == "frames [-1]"


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_repeated_text_passes_once_per_period_and_is_counted() -> None:
    clock = Clock()
    throttle = Throttle(period=5, clock=clock)
    assert [throttle("a"), throttle("a"), throttle("b"), throttle("a")] == ["a", "", "b", ""]
    clock.now = 5.0
    assert throttle("a") == "a (2 more of these before)"
    clock.now = 10.0
    assert throttle("a") == "a"


def test_a_flood_of_different_texts_is_limited_and_counted() -> None:
    clock = Clock()
    throttle = Throttle(period=5, limit=3, clock=clock)
    assert [throttle(f"{i}") for i in range(5)] == ["0", "1", "2", "", ""]
    clock.now = 5.0
    assert throttle("x") == "x (2 other messages not shown)"


@given(st.lists(st.tuples(st.integers(0, 40), st.floats(0, 3))))
def test_the_throttle_never_passes_more_than_its_limit(events: list[tuple[int, float]]) -> None:
    clock = Clock()
    throttle = Throttle(period=5, limit=4, clock=clock)
    passed: list[float] = []
    for text, pause in events:
        clock.now += pause
        if throttle(str(text)):
            passed.append(clock.now)
    assert all(sum(at - 5 < other <= at for other in passed) <= 4 for at in passed)


class FakeStream:
    """Its depth tells how many frames it has seen since its start."""

    def __init__(self, key: StreamKey) -> None:
        self.key = key
        self.seen = 0

    def reset(self, reason: str) -> None:
        self.seen = 0

    def push(self, image: np.ndarray, stamp: float | None) -> Prediction:
        self.seen += 1
        if image[0, 0, 0] == 13:
            raise ValueError("an unlucky picture")
        height, width = image.shape[:2]
        depth = torch.full((height, width), float(self.seen))
        intrinsics = torch.tensor([[0.5, 0, 0.5], [0, 1.0, 0.25], [0, 0, 1]])
        return Prediction(depth[..., None].repeat(1, 1, 3), depth, depth > 0, intrinsics)


def fake_camera(**options: Any) -> tuple[StreamSession, list[StreamKey]]:
    made: list[StreamKey] = []

    def make(key: StreamKey) -> Any:
        made.append(key)
        return FakeStream(key)

    return StreamSession(make, **options), made


IMAGE = np.zeros((4, 6, 3), np.uint8)
MATRIX = np.array([[3.0, 0, 2.5], [0, 4, 1.5], [0, 0, 1]])


def seen(camera: StreamSession, frames: list[dict[str, Any]]) -> list[tuple[int, str | None]]:
    """Per frame: how many the stream has seen, and why it started anew."""
    pushed = [camera.push(StreamFrame(**{"image": IMAGE, **frame})) for frame in frames]
    return [(int(one.depth[0, 0]), one.reset) for one in pushed]


def test_a_new_epoch_starts_the_stream_anew_once_with_its_reason() -> None:
    camera, made = fake_camera()
    frames = [{"epoch": e, "request": f"number {e}"} for e in (0, 0, 0, 1, 1, 3)]
    assert seen(camera, frames) == [
        *((1, None), (2, None), (3, None)),
        *((1, "number 1"), (2, None), (1, "number 3")),
    ]
    assert len(made) == 1
    assert camera.resets == {"number 1": 1, "number 3": 1}


def test_a_reset_before_the_first_frame_is_none() -> None:
    camera, _ = fake_camera()
    assert seen(camera, [{"epoch": 7, "stamp": 100.0}, {"epoch": 7, "stamp": 100.1}]) == [
        (1, None),
        (2, None),
    ]
    assert not camera.resets


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"image": np.zeros((6, 4, 3), np.uint8)}, NEW_SIZE),
        ({"frame_id": "left"}, NEW_FRAME_ID),
        ({"camera_matrix": MATRIX}, NEW_CAMERA),
        ({"stabilize": False}, NEW_SETTINGS),
        ({"num_tokens": 100}, NEW_SETTINGS),
    ],
)
def test_what_a_stream_depends_on_starts_another(change: dict[str, Any], reason: str) -> None:
    camera, made = fake_camera()
    expected = [(1, None), (2, None), (1, reason), (2, None), (1, reason)]
    assert seen(camera, [{}, {}, change, change, {}]) == expected
    assert len(made) == 3
    assert made[0] == made[2] != made[1]


def test_stamps_that_go_back_or_leave_a_gap_start_anew_and_small_steps_do_not() -> None:
    camera, _ = fake_camera(rules=TimeRules(tolerance=0.2, max_gap=5.0))
    stamps = [10.0, 10.1, 9.95, 14.95, 14.7, 3.0, 8.0, 13.1, None, 1.0]
    assert [reason for _, reason in seen(camera, [{"stamp": s} for s in stamps])] == [
        *(None, None, None, None, BACKWARDS, BACKWARDS, None, GAP, None, None),
    ]


def test_no_gap_is_too_long_when_the_limit_is_zero() -> None:
    camera, _ = fake_camera(rules=TimeRules(max_gap=0.0))
    assert seen(camera, [{"stamp": 1.0}, {"stamp": 1e6}]) == [(1, None), (2, None)]


def test_after_an_exception_the_stream_starts_anew() -> None:
    camera, _ = fake_camera()
    camera.push(StreamFrame(IMAGE))
    with pytest.raises(ValueError, match="an unlucky picture"):
        camera.push(StreamFrame(IMAGE + np.uint8(13)))
    assert seen(camera, [{}, {}]) == [(1, FAILED), (2, None)]


def test_the_camera_is_the_given_one_or_the_estimate_in_pixels() -> None:
    camera, _ = fake_camera()
    assert camera.push(StreamFrame(IMAGE, MATRIX)).camera_matrix is MATRIX
    estimate = camera.push(StreamFrame(IMAGE)).camera_matrix
    assert estimate.tolist() == [[3, 0, 2.5], [0, 4, 0.5], [0, 0, 1]]


def test_what_is_not_visible_is_not_valid() -> None:
    camera, _ = fake_camera()
    visible = np.arange(24).reshape(4, 6) % 2 == 0
    assert np.array_equal(camera.push(StreamFrame(IMAGE, visible=visible)).valid, visible)


class CutHook(StreamHook):
    """Asks for a new stream at stamp 2 and doubles the geometry."""

    def __init__(self) -> None:
        self.starts: list[str | None] = []

    def before_frame(self, frame: StreamFrame) -> str | None:
        return "a cut" if frame.stamp in (0.0, 2.0) else None

    def started(self, reason: str | None) -> None:
        self.starts.append(reason)

    def after_prediction(self, frame: StreamFrame, geometry: Geometry) -> Geometry:
        return geometry.scaled(2.0)


def test_a_hook_can_start_the_stream_anew_and_scale_its_geometry() -> None:
    hook = CutHook()
    camera, _ = fake_camera(hooks=[hook])
    frames = [{"stamp": float(i)} for i in range(4)]
    assert seen(camera, frames) == [(2, None), (4, None), (2, "a cut"), (4, None)]
    assert hook.starts == [None, "a cut"]
    assert camera.push(StreamFrame(IMAGE, stamp=4.0)).metric


def test_normalised_and_pixel_intrinsics_project_to_the_same_place() -> None:
    intrinsics = np.array([[0.9, 0, 0.45], [0, 1.3, 0.52], [0, 0, 1]])
    matrix = pixel_intrinsics(intrinsics, (48, 64))
    ray = np.array([0.2, -0.1, 1.0])
    x, y, _ = intrinsics @ ray
    u, v, _ = matrix @ ray
    assert ((u + 0.5) / 64, (v + 0.5) / 48) == pytest.approx((x, y))
