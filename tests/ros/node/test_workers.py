"""One thread for each device: each camera's frames go to its own."""

from __future__ import annotations

import threading

from dyfn_ros.node.workers import DeviceWorkers

DEADLINE = 20.0


class Bench:
    def __init__(self, devices: list[str], failing: str = "") -> None:
        self.done: list[tuple[str, list[int]]] = []
        self.finished = threading.Semaphore(0)
        self.failing = failing
        self.prepared: dict[str, str] = {}
        self.workers: DeviceWorkers[int] = DeviceWorkers(
            devices,
            self._work,
            prepare=self._prepare,
            keep_all=True,
            capacity=10,
            held=[False] * (len(devices) - 1) + [True],
        )
        self.workers.start()

    def _prepare(self, device: str) -> None:
        if device == self.failing:
            raise ValueError(f"no {device}")
        self.prepared[device] = threading.current_thread().name + str(threading.get_ident())

    def _work(self, frames: list[int]) -> None:
        self.done.append((str(threading.get_ident()), frames))
        self.finished.release()


def test_cameras_of_one_device_share_a_thread_and_others_do_not() -> None:
    bench = Bench(["cpu", "cuda:1", "cpu"])
    assert bench.workers.wait_prepared(DEADLINE)
    assert set(bench.prepared) == {"cpu", "cuda:1"}
    for camera in range(3):
        assert bench.workers.submit(10 * camera, camera)
    for _ in range(2):
        assert bench.finished.acquire(timeout=DEADLINE)
    assert sorted(frames for _, frames in bench.done) == [[0], [10]]  # the last is held
    bench.workers.release(2)
    assert bench.finished.acquire(timeout=DEADLINE)
    threads = {frames[0]: thread for thread, frames in bench.done}
    assert threads[0] == threads[20] != threads[10]
    assert bench.workers.stop(DEADLINE)
    assert [bench.workers.dropped(camera) for camera in range(3)] == [0, 0, 0]


def test_dropped_frames_are_those_of_their_camera() -> None:
    bench = Bench(["a", "b", "b"])
    for frame in range(3):
        bench.workers.submit(frame, 2)  # held
    assert bench.workers.discard(1) == 0
    assert bench.workers.discard(2) == 3
    assert [bench.workers.dropped(camera) for camera in range(3)] == [0, 0, 3]
    assert bench.workers.stop(DEADLINE)


def test_a_device_that_fails_is_known_at_once() -> None:
    bench = Bench(["a", "b"], failing="b")
    assert bench.workers.wait_prepared(DEADLINE)
    assert str(bench.workers.error) == "no b"
    assert bench.workers.stop(DEADLINE)
