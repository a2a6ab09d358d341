"""Where one camera was: odometry and transforms in, the pose of an image out, or why there is none.

The node and dyfn-replay run this, so that both find the same pose for the same image.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from dyfn_core.geometry.rigid import inverse, rigid, size_of
from dyfn_core.metric.pose_history import (
    DUPLICATE,
    SECOND,
    NoPose,
    Placed,
    PoseHistory,
)
from dyfn_core.metric.pose_limits import PoseLimits
from dyfn_ros.messages.images import MessageError
from dyfn_ros.messages.odometry import (
    NAMES_NO_CHILD,
    BodyPose,
    ErrorGrowth,
    decode_body_pose,
    frame_name,
)
from dyfn_ros.messages.odometry_options import TF, OdometryOptions
from dyfn_ros.messages.references import parse_pose
from dyfn_ros.messages.transforms import TransformBuffer, TransformError

NOT_TIED, NO_FRAME = "camera's place unknown", "no frame_id"
OTHER_FRAME, NEW_FRAME, UNREADABLE = "another frame", "frames changed", "not readable"
STILL = "standing still"

_GONE = 1.0  # seconds of silence after which poses of other frames take the place of the former
_STILL = 0.005  # metres or radians a second


class CameraPoses:
    """One camera's poses by its odometry. `take` and the buffer may be fed from any thread.

    Attributes:
        topic: Where the poses come from, for sentences.
        transforms: What /tf and /tf_static hold; shared by any number of cameras.
        unused: Messages that were not used, and breaks of the odometry, by reason.
        missing: Images without a pose, by reason.
        placed: Images with one.
        still: Those among them that have not moved since the one before.
    """

    def __init__(
        self,
        options: OdometryOptions,
        topic: str,
        transforms: TransformBuffer,
        warn: Callable[[str], None],
        limits: PoseLimits | None = None,
    ) -> None:
        """Start without poses.

        Args:
            options: Type and frames of the poses, and where the camera is.
            topic: Name of the topic.
            transforms: Of all frames.
            warn: Takes a sentence for what costs poses.
            limits: Of the topic's poses; None: those of the options.

        Raises:
            ValueError: camera_pose cannot be read, or goes with no frame.
        """
        self.topic = "/tf" if options.odometry_type == TF else topic
        self.transforms = transforms
        self.missing: Counter[str] = Counter()
        self.placed = self.still = 0
        self._options = options
        self._say = warn
        self._camera = ""  # frame_id of the last image
        self._first: dict[str, str] = {}  # sentence of each reason's first case
        self._counts: Counter[str] = Counter()
        self._mount = _camera_pose(options)
        self._limits = limits or options.pose_limits
        self._history = PoseHistory(self._limits)
        self._growth = ErrorGrowth()
        self._last: BodyPose | None = None
        self._arrived = 0
        self._given_up: object = None  # progress when a wait was in vain
        self._before: tuple[int, np.ndarray] | None = None  # stamp and pose of an image
        self._speed: tuple[float, float] | None = None
        self._place = ""  # how the camera's place in the moving frame is known
        self._problem = ""

    @property
    def wants_transforms(self) -> bool:
        """Whether /tf and /tf_static have to be read."""
        return self._options.odometry_type == TF or self._mount is None

    @property
    def has_topic(self) -> bool:
        """Whether there is a topic of poses beside /tf."""
        return self._options.odometry_type != TF

    @property
    def taken(self) -> int:
        """Poses that came on the topic and could be read."""
        return self._arrived

    def untied(self, frame_id: str) -> str:
        """Why the camera's place in the moving frame is unknown; "" when it is known."""
        with self.transforms.changed:
            newest = self._history.newest
            found = None if newest is None else self._find(newest, frame_name(frame_id))
        if isinstance(found, NoPose) and found.reason in (NOT_TIED, NO_FRAME):
            return f"{self.topic}: {found.detail}"
        return ""

    @property
    def unused(self) -> Counter[str]:
        """See the class."""
        with self.transforms.changed:
            found = self._counts + self._history.counts
            for target, source in self._looked_up(self._camera):
                with suppress(TransformError):  # said by `at`
                    found += self.transforms.unused(target, source)
            if self.wants_transforms:
                found += self.transforms.counts
        del found[DUPLICATE]
        return found

    def take(self, message: Any, stamp: int | None = None) -> None:
        """A message of the odometry's topic.

        Args:
            message: Of the type odometry_type.
            stamp: Nanoseconds; None: the header's.
        """
        with self.transforms.changed:
            try:
                now = decode_body_pose(message, self._options.odometry_type)
            except MessageError as error:
                self._counts[UNREADABLE] += 1
                self._warn(UNREADABLE, f"message not used: {error}")
                return
            if self._of_another_frame(now):
                return
            self._last = now
            stamp = now.stamp if stamp is None else stamp
            found = self._history.add(stamp, now.pose, self._growth.push(now))
            if found is not None and found.reason != DUPLICATE:
                self._warn(found.reason, f"the odometry {found.detail}")
            self._arrived += 1
            self.transforms.changed.notify_all()

    def wait(self, stamp: int, frame_id: str, until: float) -> bool:
        """Wait for the pose of an image, but not again while nothing comes.

        Args:
            stamp: Nanoseconds, of the image.
            frame_id: The camera's frame.
            until: time.monotonic() at which patience ends.

        Returns:
            Whether all has come that the pose rests on.
        """
        with self.transforms.changed:
            patience = until - time.monotonic()
            if self._given_up == self._arrived or patience <= 0:
                return self.reaches(stamp, frame_id)
            come = self.transforms.changed.wait_for(lambda: self.reaches(stamp, frame_id), patience)
            self._given_up = -1 if come else self._arrived
            return come

    def reaches(self, stamp: int, frame_id: str) -> bool:
        """Whether nothing that comes later changes the pose at this moment (nanoseconds)."""
        with self.transforms.changed:
            if self._options.odometry_type != TF and not self._history.reaches(stamp):
                return False
            try:
                return all(
                    self.transforms.reaches(target, source, stamp)
                    for target, source in self._looked_up(frame_name(frame_id))
                )
            except TransformError:
                return self._options.odometry_type != TF

    def at(self, stamp: int, frame_id: str) -> Placed | None:
        """The pose of an image; to be asked once for each.

        Args:
            stamp: Nanoseconds.
            frame_id: The camera's frame.

        Returns:
            4 x 4 of the camera's optical frame in the fixed frame; None when it is not known,
            which is counted and said.
        """
        with self.transforms.changed:
            self._camera = frame_name(frame_id)
            found = self._find(stamp, self._camera)
            if isinstance(found, NoPose):
                self.missing[found.reason] += 1
                self._problem = f"{self.topic}: no pose of the camera: {found.detail}"
                self._warn(found.reason, f"no pose of the camera: {found.detail}")
                return None
            self._problem = ""
            self.placed += 1
            self._measure_speed(stamp, found.pose)
            return found

    def problems(self) -> list[str]:
        """Why the last image had no pose; empty when it had one."""
        return [self._problem] if self._problem else []

    def report(self) -> dict[str, str]:
        """Name and value, for diagnostics and metrics.json."""
        found = {
            "topic": self.topic,
            "frames": self._frames(),
            "camera's place": self._place or "unknown",
            "images with a pose": str(self.placed),
            STILL: str(self.still),
        }
        if self._options.odometry_type != TF:
            found |= {"poses": str(self._arrived), "errors known by": self._growth.source}
        if self._speed is not None:
            found["speed"] = f"{self._speed[1]:.3g} m/s, {self._speed[0]:.3g} rad/s"
        found |= {f"no pose, {reason}": str(n) for reason, n in sorted(self.missing.items())}
        found |= {f"not used, {reason}": str(n) for reason, n in sorted(self.unused.items())}
        return found

    def lines(self) -> dict[str, int]:
        """What was not used and what is missing, each sentence with its number of times."""
        kinds = (("images without a pose", self.missing), ("odometry not as expected", self.unused))
        found = {}
        for what, counts in kinds:
            for reason, count in sorted(counts.items()):
                first = self._first.get(reason, "")
                text = f"{self.topic}: {what}: {reason}"
                found[f"{text} ({first})" if first else text] = count
        return found

    # With the lock held.

    def _warn(self, reason: str, text: str) -> None:
        self._first.setdefault(reason, text)
        self._say(f"{self.topic}: {text}")

    def _progress(self, frame_id: str) -> object:
        """Differs when something has come since that the pose rests on."""
        if self._options.odometry_type != TF:
            return self._arrived
        return self.transforms.newest(*self._looked_up(frame_name(frame_id))[0])

    def _of_another_frame(self, now: BodyPose) -> bool:
        """Whether a pose is of other frames than those before, which are still coming."""
        last = self._last
        if last is None or (now.frame, now.child) == (last.frame, last.child):
            return False
        if abs(now.stamp - last.stamp) > _GONE * SECOND:
            text = f"goes on as {_named(now)}, it was {_named(last)}: earlier poses are gone"
            self._warn(NEW_FRAME, text)
            self._counts.update(self._history.counts)
            self._counts[NEW_FRAME] += 1
            self._history = PoseHistory(self._limits)
            return False
        self._counts[OTHER_FRAME] += 1
        text = f"a pose of {_named(now)} is not used, the others are of {_named(last)}"
        self._warn(OTHER_FRAME, text)
        return True

    def _frames(self) -> str:
        options = self._options
        if options.odometry_type == TF:
            return f"{options.moving_frame or 'the camera'} in {options.odom_frame}"
        return "" if self._last is None else _named(self._last, options.moving_frame)

    def _moving(self) -> str:
        own = self._last.child if self._last is not None else ""
        return frame_name(self._options.moving_frame) or own

    def _looked_up(self, camera: str) -> list[tuple[str, str]]:
        """The pairs of frames that the pose needs a transform of."""
        options, moving = self._options, self._moving()
        if options.odometry_type == TF:
            end = camera if self._mount is None else moving
            return [(frame_name(options.odom_frame), end)]
        if self._mount is not None or not moving or moving == camera:
            return []
        return [(moving, camera)]

    def _find(self, stamp: int, camera: str) -> Placed | NoPose:
        if not camera and self._mount is None:
            text = "the images have no frame_id; set camera_pose"
            return NoPose(NO_FRAME, text)
        if self._options.odometry_type == TF:
            return self._by_tf(stamp, camera)
        body = self._history.at(stamp)
        if isinstance(body, NoPose):
            return body
        mount = self._mounted(stamp, camera)
        return mount if isinstance(mount, NoPose) else _carried(body, mount)

    def _by_tf(self, stamp: int, camera: str) -> Placed | NoPose:
        target, source = self._looked_up(camera)[0]
        try:
            found = self.transforms.lookup(target, source, stamp)
            if not self.transforms.moves(target, source):
                text = f"nothing on /tf moves {source!r} in {target!r}"
                return NoPose(NOT_TIED, text)
        except TransformError as error:
            return NoPose(NOT_TIED, f"{error}; odom_frame is {target!r}")
        self._place = "tf" if self._mount is None else "camera_pose"
        if isinstance(found, NoPose) or self._mount is None:
            return found
        return _carried(found, self._mount)

    def _mounted(self, stamp: int, camera: str) -> np.ndarray | NoPose:
        """The camera in the moving frame, 4 x 4."""
        moving, kind = self._moving(), self._options.odometry_type
        if self._mount is not None:
            self._place = "camera_pose"
            return self._mount
        if moving == camera:
            self._place = f"the poses are of {camera!r} itself"
            return np.eye(4)
        if not moving and kind in NAMES_NO_CHILD:
            self._place = f"a {kind} names no frame: taken for the camera's own"
            return np.eye(4)
        if not moving:
            text = f"its child_frame_id is empty and the images are of {camera!r}"
            return NoPose(NO_FRAME, f"{text}; set moving_frame or camera_pose")
        try:
            found = self.transforms.lookup(moving, camera, stamp)
        except TransformError as error:
            text = f"the odometry is of {moving!r}, the images are of {camera!r}, and {error}"
            return NoPose(NOT_TIED, f"{text}; publish the transform or set camera_pose")
        self._place = "tf"
        return found if isinstance(found, NoPose) else found.pose

    def _measure_speed(self, stamp: int, pose: np.ndarray) -> None:
        before, self._before = self._before, (stamp, pose)
        if before is None or stamp <= before[0]:
            return
        seconds = (stamp - before[0]) / SECOND
        turn, move = size_of(inverse(before[1]) @ pose)
        self._speed = turn / seconds, move / seconds
        self.still += max(self._speed) < _STILL


def _camera_pose(options: OdometryOptions) -> np.ndarray | None:
    if not options.camera_pose.strip():
        return None
    if options.odometry_type == TF and not options.moving_frame:
        raise ValueError(
            f"camera_pose is {options.camera_pose!r} with odometry_type {TF!r}, expected "
            "moving_frame to say which frame it is in"
        )
    found = parse_pose(options.camera_pose, "camera_pose")
    return rigid(found.rotation, found.translation)


def _carried(body: Placed, mount: np.ndarray) -> Placed:
    """From the moving frame to the camera on it, which errors of rotation move too."""
    variance = body.variance
    if variance is not None:
        lever = float(mount[:3, 3] @ mount[:3, 3])
        variance = variance[0], variance[1] + variance[0] * lever * 2 / 3
    return Placed(body.pose @ mount, variance)


def _named(pose: BodyPose, moving: str = "") -> str:
    return f"{moving or pose.child or 'an unnamed frame'} in {pose.frame or 'an unnamed frame'}"
