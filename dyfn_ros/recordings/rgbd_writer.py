"""RGB-D frames, and recordings made of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.typestore import Lens
from dyfn_ros.recordings.writer import DepthEncoding, RecordingWriter

ColourEncoding = Literal["jpeg", "png", "raw"]


@dataclass(frozen=True)
class FrameToRecord:
    """One moment of an RGB-D recording.

    image: H x W x 3 uint8, RGB.
    depth_m: H x W float, metres along the optical z axis; 0, NaN or inf where there is none.
        None when the frame has no ground truth.
    camera_matrix: 3 x 3 intrinsics in pixels; None when unknown.
    pose: 4 x 4 camera-to-world in metres, optical frame; None when unknown.
    stamp: seconds. lens: of an image that is distorted.
    """

    image: np.ndarray
    depth_m: np.ndarray | None
    camera_matrix: np.ndarray | None
    pose: np.ndarray | None
    stamp: float
    lens: Lens | None = None

    @property
    def stamp_ns(self) -> int:
        """See in_nanoseconds."""
        return in_nanoseconds(self.stamp)


def in_nanoseconds(seconds: float) -> int:
    """Of seconds since 1970, whose floats are no finer, to the microsecond."""
    return round(seconds * 1e9) if abs(seconds) < 1e6 else round(seconds * 1e6) * 1000


def write_rgbd_recording(
    path: str | Path,
    frames: Iterable[FrameToRecord],
    *,
    storage: str | None = None,
    overwrite: bool = False,
    namespace: str = "/camera",
    frame_id: str = "camera_optical",
    world_frame: str = "world",
    jpeg_quality: int | None = 90,
    colour: ColourEncoding = "jpeg",
    depth_encoding: DepthEncoding = "png",
) -> int:
    """Turn RGB-D frames into a recording and say how many there were.

    Topics under `namespace`: image/compressed (image for raw rgb8: colour "raw" or jpeg_quality
    None), camera_info, depth/image/compressed (depth/image for a raw depth_encoding), pose; and
    /tf.
    Raises RecordingError when there are no frames or the path exists.
    """
    count = 0
    with RecordingWriter(path, storage, overwrite=overwrite) as writer:
        for count, frame in enumerate(frames, start=1):  # noqa: B007
            stamp_ns = frame.stamp_ns
            topic = f"{namespace}/image/compressed"
            if colour == "raw" or jpeg_quality is None:
                writer.write_image(f"{namespace}/image", frame.image, stamp_ns, frame_id)
            elif colour == "png":
                writer.write_png(topic, frame.image, stamp_ns, frame_id)
            else:
                writer.write_jpeg(topic, frame.image, stamp_ns, frame_id, jpeg_quality)
            if frame.camera_matrix is not None:
                topic, size = f"{namespace}/camera_info", frame.image.shape[:2]
                writer.write_camera_info(
                    topic, frame.camera_matrix, size, stamp_ns, frame_id, frame.lens
                )
            if frame.depth_m is not None:
                suffix = "/compressed" if depth_encoding == "png" else ""
                topic = f"{namespace}/depth/image{suffix}"
                writer.write_depth(topic, frame.depth_m, stamp_ns, frame_id, depth_encoding)
            if frame.pose is not None:
                writer.write_pose(f"{namespace}/pose", frame.pose, stamp_ns, world_frame)
                writer.write_transform(frame.pose, stamp_ns, world_frame, frame_id)
        if count == 0:
            raise RecordingError(f"{path}: there are no frames to write")
    return count
