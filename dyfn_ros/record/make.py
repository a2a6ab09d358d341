"""A recording out of an RGB-D folder or a video file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import islice

import numpy as np

from dyfn_ros.record.options import RecordOptions
from dyfn_ros.record.sources import folder_frames
from dyfn_ros.recordings.camera_yaml import read_camera_yaml
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording
from dyfn_ros.recordings.typestore import Lens
from dyfn_ros.recordings.video_file import video_frames

LENSES = {4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}


def make_recording(options: RecordOptions) -> tuple[int, Counter[str]]:
    """Write the recording; -> frames in it, and what was left out, by reason.

    Raises RecordingError (source, output path, options that do not fit) and OutputError (disk).
    """
    left_out: Counter[str] = Counter()
    frames = islice(_frames(options, left_out), 0, None, options.stride)
    count = write_rgbd_recording(
        options.out,
        islice(frames, options.max_frames),
        storage=options.storage,
        overwrite=options.overwrite,
        namespace=options.namespace.rstrip("/"),
        frame_id=options.frame_id,
        jpeg_quality=options.quality,
        colour=options.colour,
        depth_encoding=options.depth,
    )
    return count, left_out


def _frames(options: RecordOptions, left_out: Counter[str]) -> Iterator[FrameToRecord]:
    def warn(reason: str) -> None:
        left_out[reason] += 1

    source = options.source
    if not source.exists():
        raise RecordingError(f"{source} does not exist; expected an RGB-D folder or a video file")
    if source.is_dir():
        if options.camera_info or options.distortion:
            raise RecordingError(
                f"{source}: --camera-info and --distortion are for videos; depth of a folder is "
                "registered to undistorted images, whose --intrinsics can be given"
            )
        return folder_frames(source, warn, options.rate, options.intrinsics, options.depth_scale)
    if options.depth_scale:
        raise RecordingError(f"{source}: --depth-scale is for folders, not for a video")
    if options.camera_info is not None and (options.intrinsics or options.distortion):
        raise RecordingError("give --camera-info, or --intrinsics and --distortion, not both")
    if options.distortion and not options.intrinsics:
        raise RecordingError("--distortion needs --intrinsics")
    camera = None if options.camera_info is None else read_camera_yaml(options.camera_info)
    return video_frames(source, warn, _matrix(options), _lens(options), camera, options.rate)


def _matrix(options: RecordOptions) -> np.ndarray | None:
    if options.intrinsics is None:
        return None
    fx, fy, cx, cy = options.intrinsics
    if not (fx > 0 and fy > 0):
        raise RecordingError(f"--intrinsics: focal lengths must be above 0, got {fx} and {fy}")
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _lens(options: RecordOptions) -> Lens | None:
    values = options.distortion
    if values is None:
        return None
    if len(values) not in LENSES:
        raise RecordingError(
            f"--distortion: expected {', '.join(map(str, LENSES))} numbers, got {len(values)}"
        )
    return Lens(LENSES[len(values)], values)
