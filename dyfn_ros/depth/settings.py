"""What `dyfn-depth` reads, runs and writes. Nothing slow is imported here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dyfn_core.stream.options import StreamOptions
from dyfn_core.threads import THREADS

VIDEO, PICTURE, PNG, NPZ, EXR, PLY, RRD = "video", "picture", "png", "npz", "exr", "ply", "rrd"
WRITE = (VIDEO, PICTURE, PNG, NPZ, EXR, PLY, RRD)
PER_FRAME = (PICTURE, PNG, NPZ, EXR, PLY)
NONE = "none"
RATE = 10.0  # pictures a second of a folder
PNG_VALUES = 1000.0  # stored values of a 16-bit PNG per unit of depth: millimetres of metres
PANEL = 1280  # pixels of the longer side of a panel of the video
METRIC_SOURCES = ("none", "fixed", "camera_height", "model")


@dataclass(frozen=True)
class Camera:
    """What is known of the camera beforehand.

    Attributes:
        fov: Horizontal field of view of the upright image, degrees.
        matrix: FX FY CX CY or nine numbers row by row, in pixels, or one file name.
        exif: Whether the EXIF of pictures is used.
    """

    fov: float | None = None
    matrix: tuple[str, ...] | None = None
    exif: bool = True


@dataclass(frozen=True)
class Reading:
    """What is read.

    Attributes:
        source: A picture, a folder, a video, a camera's number or device, an address.
        rate: Pictures a second of a folder, frames a second instead of a video's own times.
        stride: Every N-th frame is used.
        max_frames: At most this many are used; None: all.
        capture_size: (H, W) that a camera is asked for.
    """

    source: str
    rate: float | None = None
    stride: int = 1
    max_frames: int | None = None
    capture_size: tuple[int, int] | None = None


@dataclass(frozen=True)
class Writing:
    """What is written.

    Attributes:
        write: Names of WRITE; None: a picture of a picture, else a video.
        out: Folder; None: that of the source, the working directory for a camera.
        overwrite: Whether files that are there are replaced.
        panels: "both": input and depth side by side with the colours' scale; "depth" alone.
        near, far: Ends of the colours, in the unit of depth; None: they follow the scene.
        video_size: Longest side of a panel, pixels.
        png_values: Stored values of 16-bit PNGs per unit of depth.
        view: Whether the Rerun viewer is opened.
    """

    write: tuple[str, ...] | None = None
    out: Path | None = None
    overwrite: bool = False
    panels: Literal["both", "depth"] = "both"
    near: float | None = None
    far: float | None = None
    video_size: int = PANEL
    png_values: float = PNG_VALUES
    view: bool = False


@dataclass(frozen=True)
class DepthJob:
    """A command line of `dyfn-depth`: what to read, to run and to write."""

    reading: Reading
    camera: Camera
    writing: Writing
    stream: StreamOptions
    model: str = "dyfn-mini"
    device: str = "auto"
    threads: int = THREADS
    backend: str = "torch"


def parse_write(text: str) -> tuple[str, ...]:
    """A list of outputs: names of WRITE with commas between them, or "none".

    Raises:
        ValueError: A name is unknown; the text lists the known ones.
    """
    names = {name.strip() for name in text.split(",")} - {NONE}
    unknown = sorted(names - set(WRITE))
    if unknown:
        raise ValueError(f"unknown output {unknown[0]!r}, expected some of {', '.join(WRITE)}")
    return tuple(name for name in WRITE if name in names)
