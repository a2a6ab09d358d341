"""One inference thread for each device, behind the cameras' numbers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Generic, TypeVar

from dyfn_ros.node.worker import FrameWorker

T = TypeVar("T")


class DeviceWorkers(Generic[T]):
    """FrameWorkers, each with the cameras of one device; the numbers of the cameras are those of
    `devices`. See FrameWorker for the methods.
    """

    def __init__(
        self,
        devices: Sequence[str],
        work: Callable[[list[T]], None],
        *,
        prepare: Callable[[str], None],
        keep_all: bool,
        capacity: int,
        held: Sequence[bool],
    ) -> None:
        """devices, held: of each camera. prepare: takes a device, in its thread."""
        self._places: list[tuple[FrameWorker[T], int]] = []
        self._workers: list[FrameWorker[T]] = []
        counts: dict[str, int] = {}
        by_device: dict[str, FrameWorker[T]] = {}
        for device in dict.fromkeys(devices):
            by_device[device] = FrameWorker(
                work,
                prepare=partial(prepare, device),
                keep_all=keep_all,
                capacity=capacity,
                held=[waits for waits, own in zip(held, devices, strict=True) if own == device],
            )
        for device in devices:
            place = counts.get(device, 0)
            counts[device] = place + 1
            self._places.append((by_device[device], place))
        self._workers = list(by_device.values())

    @property
    def error(self) -> BaseException | None:
        """The first that a worker ended with."""
        return next((one.error for one in self._workers if one.error is not None), None)

    def start(self) -> None:
        for worker in self._workers:
            worker.start()

    def wait_prepared(self, patience: float) -> bool:
        """Whether all are, or one has ended with an error, within so many seconds."""
        until = time.monotonic() + patience
        for worker in self._workers:
            if self.error is not None:
                return True
            if not worker.wait_prepared(max(0.0, until - time.monotonic())):
                return False
        return True

    def submit(self, frame: T, camera: int) -> bool:
        worker, place = self._places[camera]
        return worker.submit(frame, place)

    def release(self, camera: int) -> None:
        worker, place = self._places[camera]
        worker.release(place)

    def dropped(self, camera: int) -> int:
        worker, place = self._places[camera]
        return worker.dropped(place)

    def discard(self, camera: int) -> int:
        worker, place = self._places[camera]
        return worker.discard(place)

    def stop(self, patience: float) -> bool:
        """patience: seconds for all of them together. -> whether all have finished."""
        for worker in self._workers:
            worker.stop(0.0)
        until = time.monotonic() + patience
        ended = [one.stop(max(0.0, until - time.monotonic())) for one in self._workers]
        return all(ended)
