"""The frame worker and its log throttle: without ROS."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dyfn_ros.node.log_throttle import Throttle
from dyfn_ros.node.recent_jobs import RecentJobs
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


@dataclass(frozen=True)
class Arrived:
    arrived: float


def test_recent_jobs_are_thinned_out_and_end_with_the_one_worked_on() -> None:
    recent: RecentJobs[Arrived] = RecentJobs()
    jobs = [Arrived(index / 30) for index in range(40)]
    for job in jobs:
        recent.add(job)
    found = recent.before(jobs[30])
    steps = np.diff([job.arrived for job in found])
    assert found[0] is jobs[0] and jobs[30] not in found
    assert steps.max() < 0.2
    assert len(found) < 10
    assert recent.before(jobs[30]) == []
    assert recent.before(jobs[39])[0].arrived > 1.0


def test_recent_jobs_are_few_however_long_nobody_asks() -> None:
    recent: RecentJobs[Arrived] = RecentJobs()
    for index in range(1000):
        recent.add(Arrived(float(index)))
    assert len(recent.before(Arrived(2000.0))) == 16
