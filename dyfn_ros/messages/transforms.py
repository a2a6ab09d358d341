"""tf2_msgs/TFMessage -> where one frame is in another at a moment; no tf2 needed."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from dyfn_core.geometry.rigid import inverse
from dyfn_core.metric.pose_history import DUPLICATE, NoPose, Placed, PoseHistory
from dyfn_core.metric.pose_limits import PoseLimits
from dyfn_ros.messages.images import MessageError
from dyfn_ros.messages.odometry import frame_name, pose_of, stamp_of


class TransformError(ValueError):
    """Two frames are not tied to each other; the text names them and says why."""


@dataclass
class _Link:
    """From a frame to its parent: over time, or for ever."""

    parent: str
    track: PoseHistory | None
    fixed: np.ndarray


class TransformBuffer:
    """The transforms of /tf and /tf_static, for any thread.

    A frame that both topics name moves. A stamp that came before is ignored, as in tf2.

    Attributes:
        counts: Transforms that could not be used, by reason.
        changed: Notified when something has come; its lock is the buffer's.
        note: Why nothing comes, for errors; "" when something may.
    """

    def __init__(self, limits: PoseLimits | None = None) -> None:
        """limits: Of each transform that moves."""
        self.counts: Counter[str] = Counter()
        self.changed = threading.Condition(threading.RLock())
        self.note = ""
        self._limits = limits or PoseLimits()
        self._moving: dict[str, _Link] = {}
        self._static: dict[str, _Link] = {}

    def take(self, message: Any, static: bool, stamp: int | None = None) -> None:
        """A TFMessage.

        Args:
            message: Its `transforms` are geometry_msgs/TransformStamped.
            static: Whether they hold for ever.
            stamp: Nanoseconds; None: those of the headers.
        """
        with self.changed:
            for transform in message.transforms:
                try:
                    self._add(transform, static, stamp)
                except MessageError as error:
                    self.counts[f"{frame_name(transform.child_frame_id)}: {error}"] += 1
            self.changed.notify_all()

    def lookup(self, target: str, source: str, stamp: int) -> Placed | NoPose:
        """Where a frame is in another.

        Args:
            target: The other frame.
            source: The frame.
            stamp: Nanoseconds.

        Returns:
            4 x 4 that takes points of `source` to `target`, without a variance; or why a transform
            on the way is not known at this moment.

        Raises:
            TransformError: The frames are not tied to each other.
        """
        with self.changed:
            up, down = self._way(target, source)
            pose = np.eye(4)
            for frame in up:
                here = self._at(frame, stamp)
                if isinstance(here, NoPose):
                    return here
                pose = here @ pose
            for frame in reversed(down):
                here = self._at(frame, stamp)
                if isinstance(here, NoPose):
                    return here
                pose = inverse(here) @ pose
            return Placed(pose)

    def reaches(self, target: str, source: str, stamp: int) -> bool:
        """Whether nothing that comes later changes the lookup at this moment (nanoseconds)."""
        with self.changed:
            return all(track.reaches(stamp) for track in self._tracks(target, source))

    def newest(self, target: str, source: str) -> tuple[int | None, ...]:
        """Newest stamps (nanoseconds) of what moves between two frames; () when they are apart."""
        with self.changed:
            try:
                return tuple(track.newest for track in self._tracks(target, source))
            except TransformError:
                return ()

    def moves(self, target: str, source: str) -> bool:
        """Whether a transform between them comes from /tf. Raises TransformError."""
        with self.changed:
            return bool(self._tracks(target, source))

    def unused(self, target: str, source: str) -> Counter[str]:
        """Breaks and refused transforms between two frames, by reason. Raises TransformError."""
        with self.changed:
            found = sum((track.counts for track in self._tracks(target, source)), Counter[str]())
            del found[DUPLICATE]  # /tf is full of them
            return found

    def root(self, frame: str) -> str:
        """The frame that nothing is known of the place of. Raises TransformError: a circle."""
        with self.changed:
            return self._chain(frame)[-1]

    # With the lock held.

    def _add(self, transform: Any, static: bool, stamp: int | None) -> None:
        child, parent = frame_name(transform.child_frame_id), frame_name(transform.header.frame_id)
        pose = pose_of(transform.transform.translation, transform.transform.rotation)
        if not child or not parent or child == parent:
            raise MessageError(f"a transform from {child!r} to {parent!r}")
        if static:
            self._static[child] = _Link(parent, None, pose)
            return
        known = self._moving.get(child)
        if known is None or known.parent != parent:
            known = self._moving[child] = _Link(parent, PoseHistory(self._limits), pose)
        assert known.track is not None
        known.track.add(stamp_of(transform.header) if stamp is None else stamp, pose)

    def _link(self, frame: str) -> _Link | None:
        return self._moving.get(frame) or self._static.get(frame)

    def _at(self, frame: str, stamp: int) -> np.ndarray | NoPose:
        link = self._link(frame)
        assert link is not None
        if link.track is None:
            return link.fixed
        found = link.track.at(stamp)
        if isinstance(found, NoPose):
            return NoPose(found.reason, f"{frame} in {link.parent}: {found.detail}")
        return found.pose

    def _chain(self, frame: str) -> list[str]:
        """The frame and all above it, up to the root."""
        chain = [frame]
        while (link := self._link(chain[-1])) is not None:
            if link.parent in chain:
                circle = [*chain[chain.index(link.parent) :], link.parent]
                raise TransformError(f"the transforms go in a circle: {' -> '.join(circle)}")
            chain.append(link.parent)
        return chain

    def _way(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """The frames below the common ancestor, on the side of the source and of the target."""
        from_source, from_target = self._chain(source), self._chain(target)
        common = next((frame for frame in from_source if frame in from_target), None)
        if common is None:
            raise TransformError(self._apart(from_source, from_target))
        return (
            from_source[: from_source.index(common)],
            from_target[: from_target.index(common)],
        )

    def _apart(self, one: list[str], other: list[str]) -> str:
        known = {*self._moving, *self._static}
        known |= {link.parent for link in (*self._moving.values(), *self._static.values())}
        for chain in (one, other):
            if chain[0] not in known:
                listed = ", ".join(sorted(known)) or "none"
                listed += f"; {self.note}" if self.note else ""
                return f"tf has no frame {chain[0]!r} (it has: {listed})"
        return (
            f"tf does not connect {one[0]!r} (below {one[-1]!r}) with {other[0]!r} "
            f"(below {other[-1]!r})"
        )

    def _tracks(self, target: str, source: str) -> list[PoseHistory]:
        up, down = self._way(target, source)
        links = [self._link(frame) for frame in (*up, *down)]
        return [link.track for link in links if link is not None and link.track is not None]
