"""Where the camera was: poses out of a recording's pose, odometry and TF topics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from dyfn_core.geometry.rigid import inverse, quaternion_rotation, rigid
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_folder import is_rgbd_folder, read_poses
from dyfn_ros.recordings.storage.open import Storage, open_storage
from dyfn_ros.recordings.topics import NONE
from dyfn_ros.recordings.typestore import POSE, TF

POSE_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE_KINDS = (POSE, POSE_COVARIANCE, ODOMETRY, TF)
STATIC = "tf_static"
MAX_GAP = 0.5  # seconds between two poses that are interpolated
TOLERANCE = 0.02  # seconds beyond the first and the last pose that they stand for

# Takes a frame's index and stamp in ns, gives its pose, 4 x 4 camera to world, or None.
PoseLookup = Callable[[int, int], "np.ndarray | None"]


class PoseError(RecordingError):
    """There are no usable poses; the message says why."""


@dataclass
class PoseTrack:
    """The pose of one thing over time; stamps may come in any order."""

    stamps: list[int] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    _sorted: tuple[np.ndarray, np.ndarray] | None = None

    def add(self, stamp_ns: int, pose: np.ndarray) -> None:
        """pose: 4 x 4; of several with one stamp the last counts."""
        self.stamps.append(stamp_ns)
        self.poses.append(pose)
        self._sorted = None

    def at(self, stamp_ns: int) -> np.ndarray | None:
        """Interpolated between neighbours at most MAX_GAP apart; None farther from any pose."""
        stamps, poses = self._in_order()
        after = int(np.searchsorted(stamps, stamp_ns))
        if after < len(stamps) and stamps[after] == stamp_ns:
            exact: np.ndarray = poses[after]
            return exact
        if 0 < after < len(stamps) and stamps[after] - stamps[after - 1] <= MAX_GAP * 1e9:
            return _between(poses[after - 1], poses[after], stamps[after - 1 : after + 1], stamp_ns)
        beside = [i for i in (after - 1, after) if 0 <= i < len(stamps)]
        nearest = min(beside, key=lambda i: abs(int(stamps[i]) - stamp_ns), default=None)
        if nearest is None or abs(int(stamps[nearest]) - stamp_ns) > TOLERANCE * 1e9:
            return None
        alone: np.ndarray = poses[nearest]
        return alone

    def _in_order(self) -> tuple[np.ndarray, np.ndarray]:
        if self._sorted is None:
            last = dict(zip(self.stamps, self.poses, strict=True))
            stamps = sorted(last)
            poses = np.array([last[stamp] for stamp in stamps]).reshape(-1, 4, 4)
            self._sorted = (np.array(stamps, np.int64), poses)
        return self._sorted


def _between(first: np.ndarray, second: np.ndarray, ends: np.ndarray, stamp: int) -> np.ndarray:
    share = float(stamp - ends[0]) / float(ends[1] - ends[0])
    turn = Slerp([0, 1], Rotation.from_matrix([first[:3, :3], second[:3, :3]]))(share)
    return rigid(turn.as_matrix(), (1 - share) * first[:3, 3] + share * second[:3, 3])


@dataclass
class TransformTree:
    """Child frame -> its parent and where it is in it, over time or for ever (static)."""

    moving: dict[str, tuple[str, PoseTrack]] = field(default_factory=dict)
    static: dict[str, tuple[str, np.ndarray]] = field(default_factory=dict)

    def add(self, transform: Any, static: bool) -> None:
        """transform: geometry_msgs/TransformStamped."""
        child, parent = _name(transform.child_frame_id), _name(transform.header.frame_id)
        pose = _matrix(transform.transform.translation, transform.transform.rotation)
        if static:
            self.static[child] = (parent, pose)
        else:
            known = self.moving.get(child)
            track = PoseTrack() if known is None or known[0] != parent else known[1]
            self.moving[child] = (parent, track)
            track.add(_nanoseconds(transform.header), pose)

    def chain(self, frame: str) -> list[PoseTrack | np.ndarray]:
        """What leads from a frame up to its root, the frame's own transform first."""
        links: list[PoseTrack | np.ndarray] = []
        seen = {frame}
        while frame in self.moving or frame in self.static:
            link: PoseTrack | np.ndarray
            frame, link = self.moving[frame] if frame in self.moving else self.static[frame]
            links.append(link)
            if frame in seen:
                raise PoseError(f"TF goes in a circle at {frame}")
            seen.add(frame)
        return links

    def fixed(self, child: str, ancestor: str) -> np.ndarray | None:
        """4 x 4, points of `child` -> `ancestor`, by static transforms alone; None without."""
        pose, frame = np.eye(4), child
        for _ in range(len(self.static) + 1):
            if frame == ancestor:
                return pose
            if frame not in self.static:
                return None
            frame, link = self.static[frame]
            pose = link @ pose
        return None


def _at(links: list[PoseTrack | np.ndarray], stamp_ns: int) -> np.ndarray | None:
    pose = np.eye(4)
    for link in links:
        here = link.at(stamp_ns) if isinstance(link, PoseTrack) else link
        if here is None:
            return None
        pose = here @ pose
    return pose


def open_poses(path: Path, frame_id: str, topic: str | None = None) -> PoseLookup:
    """Where the camera with this frame_id was when a frame of the recording was taken.

    topic: PoseStamped or PoseWithCovarianceStamped (of the optical frame), Odometry (its child
    frame must be the camera or be tied to it by static TF), or TFMessage; None: TF when it leads
    from the camera to a root through something that moves, else the only pose or odometry topic.
    "none" does without. An RGB-D folder has its own. Raises PoseError: no poses, several
    candidates (listed), a topic that is absent or of another type.
    """
    if topic == NONE:
        raise PoseError("poses were not wanted")
    if path.is_dir() and is_rgbd_folder(path):
        poses = read_poses(path)
        if not poses:
            raise PoseError(f"{path} holds no poses.txt or groundtruth.txt of its frames")
        return lambda index, stamp_ns: poses.get(stamp_ns)
    storage = open_storage(path)
    kinds = {name: t.kind for name, t in storage.topics.items() if t.kind in POSE_KINDS and t.count}
    tree = _read_tree(storage, kinds)
    if topic is not None and topic not in kinds:
        raise PoseError(f"{path}: no topic {topic} of poses, odometry or TF: {_listing(kinds)}")
    if topic is None or kinds[topic] == TF:
        links = tree.chain(_name(frame_id))
        if any(isinstance(link, PoseTrack) for link in links):
            return lambda index, stamp_ns: _at(links, stamp_ns)
        if topic is not None:
            raise PoseError(f"{path}: {topic} does not say where {frame_id!r} moves")
    chosen = topic or _only(path, kinds)
    track = _read_track(storage, chosen, kinds[chosen], _name(frame_id), tree)
    return lambda index, stamp_ns: track.at(stamp_ns)


def _only(path: Path, kinds: dict[str, str]) -> str:
    candidates = {name: kind for name, kind in kinds.items() if kind != TF}
    if len(candidates) != 1:
        problem = "several topics may be the pose; choose one with --pose-topic"
        problem = problem if candidates else "no pose or odometry topic, and no TF to the camera"
        raise PoseError(f"{path}: {problem}: {_listing(candidates or kinds)}")
    return next(iter(candidates))


def _listing(kinds: dict[str, str]) -> str:
    return ", ".join(f"{name} ({kind})" for name, kind in sorted(kinds.items())) or "it has none"


def _read_tree(storage: Storage, kinds: dict[str, str]) -> TransformTree:
    tree = TransformTree()
    for recorded in storage.messages([name for name, kind in kinds.items() if kind == TF]):
        for transform in recorded.message().transforms:
            tree.add(transform, static=recorded.topic.endswith(STATIC))
    return tree


def _read_track(
    storage: Storage, topic: str, kind: str, frame_id: str, tree: TransformTree
) -> PoseTrack:
    track = PoseTrack()
    for recorded in storage.messages([topic]):
        message = recorded.message()
        pose = message.pose if kind == POSE else message.pose.pose
        matrix = _matrix(pose.position, pose.orientation)
        if kind == ODOMETRY:
            matrix = matrix @ _mounting(topic, _name(message.child_frame_id), frame_id, tree)
        track.add(_nanoseconds(message.header), matrix)
    return track


def _mounting(topic: str, body: str, camera: str, tree: TransformTree) -> np.ndarray:
    """4 x 4: the camera's pose in the body that odometry is of."""
    if (direct := tree.fixed(camera, body)) is not None:
        return direct
    if (other := tree.fixed(body, camera)) is not None:
        return inverse(other)
    raise PoseError(f"{topic} is of {body!r}, and no static TF ties it to the camera {camera!r}")


def _matrix(position: Any, orientation: Any) -> np.ndarray:
    q, p = orientation, position
    try:
        rotation = quaternion_rotation(q.w, q.x, q.y, q.z)
    except ValueError as error:
        raise PoseError(str(error)) from error
    return rigid(rotation, np.array([p.x, p.y, p.z]))


def _name(frame_id: str) -> str:
    """Frame names of tf1 began with a slash."""
    return str(frame_id).lstrip("/")


def _nanoseconds(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
