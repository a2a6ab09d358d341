"""Recordings in and out."""

from dyfn_ros.recording_writer import (
    RecordingError,
    RecordingWriter,
    RgbdFrame,
    write_rgbd_recording,
)

__all__ = ["RecordingError", "RecordingWriter", "RgbdFrame", "write_rgbd_recording"]
