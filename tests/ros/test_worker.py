"""The frame worker, its log throttle, and a camera's stream: without ROS."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dyfn_core.prediction import Prediction
from dyfn_ros.camera_stream import CameraStream, StreamKey, pixel_matrix
from dyfn_ros.throttle import Throttle
from dyfn_ros.worker import FrameWorker

DEADLINE = 20.0


class Bench:
    """A worker whose work waits for a permit per frame."""

    def __init__(self, **options: Any) -> None:
        self.started = threading.Semaphore(0)
        self.permits = threading.Semaphore(0)
        self.finished = threading.Semaphore(0)
        self.done: list[int] = []
        self.errors: list[BaseException] = []
        self.worker: FrameWorker[int] = FrameWorker(self._work, failed=self._fail, **options)
        self.worker.start()

    def _work(self, frame: int) -> None:
        self.started.release()
        assert self.permits.acquire(timeout=DEADLINE)
        if frame < 0:
            raise ValueError(f"frame {frame}")
        self.done.append(frame)
        self.finished.release()

    def _fail(self, error: BaseException) -> None:
        self.errors.append(error)
        self.finished.release()

    def let(self, count: int) -> None:
        self.permits.release(count)
        for _ in range(count):
            assert self.finished.acquire(timeout=DEADLINE)


def test_the_latest_frame_replaces_the_waiting_one() -> None:
    bench = Bench()
    assert bench.worker.submit(1)
    assert bench.started.acquire(timeout=DEADLINE)
    assert all(bench.worker.submit(frame) for frame in (2, 3, 4))
    bench.let(2)
    assert bench.worker.stop(DEADLINE)
    assert (bench.done, bench.worker.dropped) == ([1, 4], 2)


def test_a_queue_keeps_order_and_refuses_when_full() -> None:
    bench = Bench(keep_all=True, capacity=3)
    bench.worker.submit(1)
    assert bench.started.acquire(timeout=DEADLINE)
    assert [bench.worker.submit(frame) for frame in (2, 3, 4, 5)] == [True, True, True, False]
    bench.let(4)
    bench.worker.stop(DEADLINE)
    assert (bench.done, bench.worker.dropped) == ([1, 2, 3, 4], 1)


def test_discard_drops_what_waits_and_not_what_runs() -> None:
    bench = Bench(keep_all=True, capacity=9)
    bench.worker.submit(1)
    assert bench.started.acquire(timeout=DEADLINE)
    bench.worker.submit(2)
    bench.worker.submit(3)
    assert bench.worker.discard() == 2
    bench.worker.submit(4)
    bench.let(2)
    bench.worker.stop(DEADLINE)
    assert (bench.done, bench.worker.dropped) == ([1, 4], 2)


def test_a_held_worker_begins_when_released() -> None:
    bench = Bench(keep_all=True, capacity=9, held=True)
    bench.worker.submit(1)
    bench.worker.submit(2)
    assert not bench.started.acquire(timeout=0.05)
    bench.worker.release()
    bench.let(2)
    bench.worker.stop(DEADLINE)
    assert bench.done == [1, 2]


def test_stop_counts_what_waits_and_gives_up_on_endless_work() -> None:
    bench = Bench(keep_all=True, capacity=9)
    bench.worker.submit(1)
    assert bench.started.acquire(timeout=DEADLINE)
    bench.worker.submit(2)
    assert not bench.worker.stop(patience=0.05)
    assert bench.worker.dropped == 1
    bench.let(1)
    assert bench.worker.stop(DEADLINE)
    assert bench.done == [1]


def test_prepare_runs_first_and_its_failure_is_told() -> None:
    bench = Bench(prepare=lambda: (_ for _ in ()).throw(OSError("no such model")))
    assert bench.finished.acquire(timeout=DEADLINE)
    assert bench.worker.stop(DEADLINE)
    assert [str(error) for error in bench.errors] == ["no such model"]


def test_an_exception_in_work_ends_the_thread_and_is_told() -> None:
    bench = Bench()
    bench.worker.submit(-1)
    bench.let(1)
    assert bench.worker.stop(DEADLINE)
    assert [str(error) for error in bench.errors] == ["frame -1"]


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

    def reset(self) -> None:
        self.seen = 0

    def push(self, image: np.ndarray, stamp: float | None) -> Prediction:
        self.seen += 1
        if stamp is not None and stamp < 0:
            raise ValueError("before the beginning")
        height, width = image.shape[:2]
        depth = torch.full((height, width), float(self.seen))
        intrinsics = torch.tensor([[0.5, 0, 0.5], [0, 1.0, 0.25], [0, 0, 1]])
        return Prediction(depth[..., None].repeat(1, 1, 3), depth, depth > 0, intrinsics)


def fake_camera() -> tuple[CameraStream, list[StreamKey]]:
    made: list[StreamKey] = []

    def make(key: StreamKey) -> Any:
        made.append(key)
        return FakeStream(key)

    return CameraStream(make), made


IMAGE = np.zeros((4, 6, 3), np.uint8)
MATRIX = np.array([[3.0, 0, 2.5], [0, 4, 1.5], [0, 0, 1]])


def test_a_new_epoch_starts_the_stream_anew_once() -> None:
    camera, made = fake_camera()
    seen = [camera.push(IMAGE, None, epoch=e).depth[0, 0] for e in (0, 0, 0, 1, 1, 3)]
    assert seen == [1, 2, 3, 1, 2, 1]
    assert len(made) == 1


@pytest.mark.parametrize(
    "change",
    [
        {"image": np.zeros((6, 4, 3), np.uint8)},
        {"camera_matrix": MATRIX},
        {"stabilize": False},
        {"num_tokens": 100},
    ],
)
def test_what_a_stream_depends_on_starts_another(change: dict[str, Any]) -> None:
    camera, made = fake_camera()
    usual = {"image": IMAGE, "camera_matrix": None}
    seen = [camera.push(**{**usual, **c}).depth[0, 0] for c in ({}, {}, change, change, {})]
    assert seen == [1, 2, 1, 2, 1]
    assert len(made) == 3
    assert made[0] == made[2] != made[1]


def test_after_an_exception_the_stream_starts_anew() -> None:
    camera, _ = fake_camera()
    camera.push(IMAGE, None)
    with pytest.raises(ValueError, match="before the beginning"):
        camera.push(IMAGE, None, stamp=-1.0)
    assert camera.push(IMAGE, None).depth[0, 0] == 1


def test_the_camera_is_the_given_one_or_the_estimate_in_pixels() -> None:
    camera, _ = fake_camera()
    assert camera.push(IMAGE, MATRIX).camera_matrix is MATRIX
    estimate = camera.push(IMAGE, None).camera_matrix
    assert estimate.tolist() == [[3, 0, 2.5], [0, 4, 0.5], [0, 0, 1]]


def test_normalised_and_pixel_intrinsics_project_to_the_same_place() -> None:
    intrinsics = np.array([[0.9, 0, 0.45], [0, 1.3, 0.52], [0, 0, 1]])
    matrix = pixel_matrix(intrinsics, 48, 64)
    ray = np.array([0.2, -0.1, 1.0])
    x, y, _ = intrinsics @ ray
    u, v, _ = matrix @ ray
    assert ((u + 0.5) / 64, (v + 0.5) / 48) == pytest.approx((x, y))


def test_environment_adds_a_venv_with_ros_and_leaves_a_sourced_ros_alone(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dyfn_ros import environment

    def prefix(name: str, holds_ros: bool) -> str:
        packages = tmp_path / name / "share/ament_index/resource_index/packages"
        packages.mkdir(parents=True)
        if holds_ros:
            (packages / "rclpy").touch()
        return str(tmp_path / name)

    venv, plain = prefix("venv", True), prefix("plain", False)
    overlay, ros = prefix("overlay", False), prefix("ros", True)
    cases = [
        (venv, None, venv),
        (venv, "", venv),
        (venv, overlay, f"{overlay}:{venv}"),
        (venv, f"{overlay}:{ros}", f"{overlay}:{ros}"),
        (plain, None, None),
        (plain, overlay, overlay),
    ]
    for sys_prefix, before, after in cases:
        variables = {} if before is None else {"AMENT_PREFIX_PATH": before}
        monkeypatch.setattr(environment, "sys", SimpleNamespace(prefix=sys_prefix))
        monkeypatch.setattr(environment.os, "environ", variables)
        environment.prepare_environment()
        assert variables.get("AMENT_PREFIX_PATH") == after
