"""Recordings as sequences of frames: image, intrinsics and ground truth, matched by stamp."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from dyfn_core.data.rgbd.layouts import FolderOptions
from dyfn_core.prediction import DEPTH
from dyfn_ros.messages.encodings import FULL_BITS
from dyfn_ros.messages.references import Transform, parse_pose
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.frames import RecordedFrame, Recording
from dyfn_ros.recordings.image_recording import ImageRecording, is_image_recording
from dyfn_ros.recordings.rgbd_folder import RgbdRecording, is_rgbd_folder
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording
from dyfn_ros.recordings.ros import BagRecording
from dyfn_ros.recordings.storage.open import Storage, open_storage
from dyfn_ros.recordings.topics import Topics, choose_topics, realsense_scale
from dyfn_ros.recordings.topics import image_topics as list_image_topics
from dyfn_ros.recordings.typestore import POINT_CLOUD
from dyfn_ros.recordings.writer import RecordingWriter

__all__ = [
    "FrameToRecord",
    "RecordedFrame",
    "Recording",
    "RecordingError",
    "RecordingWriter",
    "RgbdRecording",
    "image_topics",
    "open_recording",
    "write_rgbd_recording",
]


def open_recording(
    path: str | Path,
    image_topic: str | None = None,
    camera_info_topic: str | None = None,
    depth_topic: str | None = None,
    tolerance: float = 0.02,
    *,
    depth_info_topic: str | None = None,
    depth_transform: str | None = None,
    stamps: Literal["header", "log"] = "header",
    quantity: str = DEPTH,
    depth_scale: float | None = None,
    depth_offset: float = 0.0,
    image_bits: int = FULL_BITS,
) -> Recording:
    """Open a rosbag2 folder, a bare .mcap, .db3 or .bag file, an RGB-D folder, a video file or a
    folder of pictures.

    A topic that is None is found by type when there is one candidate; "none" means to do without
    (camera info, depth). depth_info_topic: CameraInfo of a depth camera that is not the image's.
    depth_transform: 'x y z qx qy qz qw', pose of the depth camera or the point cloud's sensor in
    the image's optical frame; None: at its optical centre. tolerance: seconds between the stamps
    of an image and its ground truth. stamps: "header", or "log" for the time of recording.
    quantity: what the depth topic's images hold, see GroundTruth. depth_scale: stored depth values
    per metre; None: as the encoding or the folder's layout says. depth_offset: seconds by which
    the depth's stamps are after those of images of the same moment, which is taken away.
    image_bits: that the values of 16-bit images have.
    Raises RecordingError: not a recording, nothing readable, no image topic, or several
    candidates, which are then listed with their types; ValueError for wrong options.
    """
    path = Path(path)
    if stamps not in ("header", "log"):
        raise ValueError(f"stamps is {stamps!r}, expected 'header' or 'log'")
    transform = parse_pose(depth_transform, "depth_transform") if depth_transform else None
    if path.is_dir() and is_rgbd_folder(path):
        return RgbdRecording(
            path, FolderOptions(depth_scale=depth_scale, depth_offset=depth_offset)
        )
    if is_image_recording(path):
        return ImageRecording(path)
    storage = open_storage(path)
    topics = choose_topics(
        path, storage, image_topic, camera_info_topic, depth_topic, depth_info_topic
    )
    _check_depth(path, storage, topics, transform, quantity)
    depth_scale = depth_scale or realsense_scale(storage, topics.depth)
    return BagRecording(
        path,
        storage,
        topics,
        tolerance,
        transform,
        stamps,
        quantity,
        depth_scale,
        depth_offset,
        image_bits,
    )


def _check_depth(
    path: Path, storage: Storage, topics: Topics, transform: Transform | None, quantity: str
) -> None:
    """Refuse what the depth topic is asked for and cannot be."""
    if topics.depth is None:
        return
    kind = storage.topics[topics.depth].kind
    if transform is not None and topics.depth_info is None and kind != POINT_CLOUD:
        raise RecordingError(
            f"{path}: a depth transform needs the CameraInfo of {topics.depth}; name it with "
            "--depth-info-topic"
        )
    if quantity != DEPTH and kind == POINT_CLOUD:
        raise RecordingError(
            f"{path}: {topics.depth} is {POINT_CLOUD}, expected images of {quantity}"
        )


def image_topics(path: str | Path) -> list[str | None]:
    """Every colour image topic of a recording, for open_recording; [None] of what has
    no topics.

    Raises RecordingError as open_recording does, but for several candidates.
    """
    path = Path(path)
    if (path.is_dir() and is_rgbd_folder(path)) or is_image_recording(path):
        return [None]
    return [*list_image_topics(path, open_storage(path))]
