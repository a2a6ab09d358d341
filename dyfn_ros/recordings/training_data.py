"""A ROS recording as training data: the data kind `recording`.

A recording can only be read from its start, and clips are drawn at random. So its frames are
written once to a folder of pictures, which later runs find again. With poses it is read in the
order of time, and nothing is written.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from dyfn_core.data.datasets import DataKind
from dyfn_core.data.files import read_colour, read_float16_png, registered, rgbd_frame
from dyfn_core.data.frames import (
    DataError,
    DataReport,
    FrameError,
    FrameSequence,
    NumberedSequence,
    RgbdFrame,
    camera_intrinsics,
)
from dyfn_core.data.posed import PosedFrame, PosedRecording
from dyfn_core.metric.pose_history import SECOND
from dyfn_ros.messages.odometry_options import ODOMETRY, OdometryOptions
from dyfn_ros.recordings.open import RecordedFrame, RecordingError, open_recording
from dyfn_ros.recordings.poses import PoseTopic
from dyfn_ros.recordings.storage.open import is_recording, open_storage
from dyfn_ros.recordings.topics import listed_topics

EXPECTED = "a rosbag2 folder, .mcap, .db3 or .bag file with a colour and a depth image topic"
FORMAT = 1  # of the folder of pictures
CACHE_VARIABLE = "DYFN_CACHE"
JPEG_QUALITY = 95


def open_recording_kind(
    root: Path,
    report: DataReport,
    *,
    image_topic: str | None = None,
    camera_info_topic: str | None = None,
    depth_topic: str | None = None,
    tolerance: float = 0.02,
    intrinsics: tuple[float, float, float, float] | None = None,
    max_gap: float = 0.5,
    max_side: int = 1024,
    cache: Path | None = None,
) -> list[FrameSequence]:
    """Frames of a recording that have depth and intrinsics, cut where stamps jump.

    image_topic, camera_info_topic, depth_topic: found by type when there is one candidate.
    Depth is registered to the colour image: 16UC1 (mm), 32FC1 (m), 16-bit PNG or compressedDepth.
    tolerance: seconds between the stamps of an image and its depth. intrinsics: fx, fy, cx, cy in
    pixels instead of the CameraInfo's. max_gap: seconds between frames with depth that are a cut,
    as is a stamp that goes back. max_side: larger frames are shrunk to this. cache: folder for
    the pictures (default: $DYFN_CACHE, else the user's cache folder); depth is kept there as
    float16, which rounds it by 0.05 % at most. Frames are numbered as in the recording.
    Raises DataError: no recording, no depth topic, not one usable frame.
    """
    topics = (image_topic, camera_info_topic, depth_topic)
    wanted = {
        "topics": topics,
        "tolerance": tolerance,
        "intrinsics": intrinsics,
        "max_side": max_side,
    }
    folder = (cache or _cache_folder()) / f"{root.stem}-{_fingerprint(root, wanted)}"
    if not (folder / "meta.json").exists():
        _write_pictures(root, folder, topics, tolerance, intrinsics, max_side)
    meta: dict[str, Any] = json.loads((folder / "meta.json").read_text())
    for reason, count in meta["problems"].items():
        for _ in range(count):
            report.miss(reason, root)
    frames: dict[int, tuple[int, list[float]]] = {
        number: (stamp, camera) for number, stamp, camera in meta["frames"]
    }
    reader = partial(_read, folder, frames)
    return [
        NumberedSequence(f"{root}[{run[0]}..{run[-1]}]", run, reader)
        for run in _runs({number: stamp for number, (stamp, _) in frames.items()}, max_gap)
    ]


def _runs(stamps: dict[int, int], max_gap: float) -> list[list[int]]:
    """Frame numbers in runs whose stamps (ns) rise by no more than max_gap seconds."""
    runs: list[list[int]] = []
    previous: int | None = None
    for number, stamp in stamps.items():
        if previous is None or not 0 < stamp - previous <= max_gap * 1e9:
            runs.append([])
        runs[-1].append(number)
        previous = stamp
    return runs


def _read(folder: Path, frames: dict[int, tuple[int, list[float]]], number: int) -> RgbdFrame:
    image = read_colour(folder / f"{number:06d}.jpg")
    depth_path = folder / f"{number:06d}.png"
    camera = np.array(frames[number][1], np.float32)
    return rgbd_frame(image, read_float16_png(depth_path), camera, None, depth_path)


def _cache_folder() -> Path:
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named) / "recordings"
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "dyfn" / "recordings"


def _fingerprint(root: Path, wanted: dict[str, Any]) -> str:
    """Of the recording's files (names, sizes, times) and of what is wanted from it."""
    if not root.exists():
        raise DataError(f"{root} does not exist; expected {EXPECTED}")
    files = sorted(path for path in root.rglob("*") if path.is_file()) if root.is_dir() else [root]
    state = [(str(f.resolve()), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    text = json.dumps([FORMAT, state, wanted], default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _write_pictures(
    root: Path,
    folder: Path,
    topics: tuple[str | None, str | None, str | None],
    tolerance: float,
    intrinsics: tuple[float, float, float, float] | None,
    max_side: int,
) -> None:
    """Read the recording once; the folder appears when it is complete."""
    try:
        recording = open_recording(root, *topics, tolerance)
        if recording.topics.depth is None:
            held = listed_topics(open_storage(root))
            raise DataError(f"{root}: no depth topic to train on; it holds {held}")
    except RecordingError as error:
        raise DataError(str(error)) from error
    partial_folder = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    partial_folder.mkdir(parents=True)
    try:
        problems: Counter[str] = Counter()
        frames = []
        total = recording.expected_frames
        for frame in tqdm(recording.frames(), f"reading {root.name}", total, unit="frame"):
            try:
                camera = _write_frame(frame, partial_folder, tolerance, intrinsics, max_side)
            except FrameError as error:
                problems[str(error)] += 1
                continue
            frames.append((frame.index, frame.stamp_ns, camera))
        problems += recording.notes.losses + _other_warnings(recording.notes.warnings)
        problems.update(recording.doubts())
        meta = {"recording": str(root), "frames": frames, "problems": problems}
        (partial_folder / "meta.json").write_text(json.dumps(meta))
        if folder.exists():  # another process was faster
            shutil.rmtree(partial_folder)
        else:
            partial_folder.replace(folder)
    except BaseException:
        shutil.rmtree(partial_folder, ignore_errors=True)
        raise


def _other_warnings(warnings: Counter[str]) -> Counter[str]:
    """All but those about depth that is absent, which every such frame counts already."""
    return Counter({text: n for text, n in warnings.items() if "no depth at" not in text})


def _write_frame(
    frame: RecordedFrame,
    folder: Path,
    tolerance: float,
    intrinsics: tuple[float, float, float, float] | None,
    max_side: int,
) -> list[float]:
    """Write one frame; returns its normalised intrinsics. Raises FrameError without frame."""
    if frame.depth is None:
        raise FrameError(f"image without depth within {tolerance:g} s (`tolerance`) of its stamp")
    if intrinsics is None:
        if frame.camera_matrix is None:
            raise FrameError("image without usable CameraInfo (or give `intrinsics`)")
        k = frame.camera_matrix
        intrinsics = (k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    camera = camera_intrinsics(*intrinsics, frame.image.shape[:2])
    image, depth = registered(frame.image, frame.depth, Path("the depth topic"))
    shrink = max_side / max(depth.shape)
    if shrink < 1:
        size = (round(depth.shape[1] * shrink), round(depth.shape[0] * shrink))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        depth = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
    colour = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    name = str(folder / f"{frame.index:06d}")
    stored = depth.astype(np.float16).view(np.uint16)
    if not (
        cv2.imwrite(f"{name}.jpg", image[..., ::-1], colour)
        and cv2.imwrite(f"{name}.png", stored, fast)
    ):
        raise DataError(f"{folder}: cannot write pictures there")
    return [float(value) for value in camera]


def open_posed_recording(
    root: Path,
    *,
    image_topic: str | None = None,
    camera_info_topic: str | None = None,
    depth_topic: str | None = None,
    tolerance: float = 0.02,
    odometry_topic: str | None = None,
    odometry_type: str = ODOMETRY,
    odom_frame: str = OdometryOptions.odom_frame,
    moving_frame: str = "",
    camera_pose: str = "",
) -> list[PosedRecording]:
    """A recording with odometry, with or without depth.

    Args:
        root: The recording.
        image_topic: Found by type when there is one candidate, as the two next ones.
        camera_info_topic: Of the image topic.
        depth_topic: Registered to the colour image.
        tolerance: Seconds between the stamps of an image and its depth.
        odometry_topic: Found by type, see recordings.poses.PoseTopic.
        odometry_type: One of OdometryOptions.odometry_type, as the next ones.
        odom_frame: For TF.
        moving_frame: Whose pose the odometry is; "": the message's.
        camera_pose: In the moving frame; "": by /tf and /tf_static.

    Raises:
        DataError: It cannot be opened, or has no poses.
    """
    frames = OdometryOptions(odometry_type, odom_frame, moving_frame, camera_pose)
    try:
        recording = open_recording(root, image_topic, camera_info_topic, depth_topic, tolerance)
        PoseTopic(root, frames, odometry_topic)  # says what is wrong before anything is read
    except (RecordingError, ValueError) as error:
        raise DataError(str(error)) from error
    problems: Counter[str] = Counter()

    def read() -> Iterator[PosedFrame]:
        poses = PoseTopic(root, frames, odometry_topic)
        for frame in recording.frames():
            if frame.camera_matrix is None:
                problems["image without usable CameraInfo"] += 1
                continue
            placed = poses.at(frame.stamp_ns, frame.frame_id, frame.source.log_ns)
            yield PosedFrame(
                frame.image,
                frame.stamp_ns / SECOND,
                frame.camera_matrix,
                None if placed is None else placed.pose,
                None if placed is None else placed.variance,
                frame.depth,
                frame.visible,
            )
        notes = (recording.notes.losses, recording.notes.warnings, poses.losses)
        for found in (*notes, poses.poses.lines()):
            problems.update(found)

    return [PosedRecording(str(root), recording.expected_frames, read, problems)]


RECORDING = DataKind("recording", open_recording_kind, EXPECTED, is_recording, open_posed_recording)
