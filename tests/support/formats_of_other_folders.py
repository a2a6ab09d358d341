"""Folders of public data sets and apps that are laid out in their own ways, for docs/recordings.md.

Each maker takes a folder that is empty and gives the path to open.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import av
import numpy as np
from PIL import Image

from tests.support.formats_of_bags import COUNT, Maker, millimetres
from tests.support.formats_of_folders import (
    LATE,
    TIMES,
    bgr,
    fifths,
    numbered,
    video,
    with_text,
    write,
)
from tests.support.numbered import SIZE, depth, picture

UPSIDE_DOWN, ORIENTATION = 3, 0x0112


def openloris(folder: Path) -> Path:
    """depth/ is the sensor's own, of another view."""
    for index, time in enumerate(TIMES):
        write(folder / f"color/{time:.6f}.png", bgr(index))
        write(folder / f"aligned_depth/{time:.6f}.png", millimetres(index))
        write(folder / f"depth/{time + LATE:.6f}.png", 2 * millimetres(index))
    return folder


def redwood(folder: Path) -> Path:
    for index in range(COUNT):
        late = 9000 if index else 0
        write(folder / f"rgb/{index + 1:07d}-{33_333 * index:012d}.jpg", bgr(index))
        write(
            folder / f"depth/{index + 1:07d}-{33_333 * index + late:012d}.png", millimetres(index)
        )
    return folder


def turned(folder: Path) -> Path:
    """EXIF says to turn the pictures, but not their depth."""
    numbered(colour="rgb/{0}.jpg")(folder)
    for index in range(COUNT):
        image = Image.fromarray(picture(index))
        tags = image.getexif()
        tags[ORIENTATION] = UPSIDE_DOWN
        image.save(folder / f"rgb/{index}.jpg", exif=tags, quality=100)
    return folder


def packed_floats(folder: Path) -> Path:
    numbered(truth="")(folder)
    for index in range(COUNT):
        bits = np.ascontiguousarray(depth(index)).view(np.uint8).reshape(*SIZE, 4)
        write(folder / f"depth/{index}.png", bits)
    return folder


def two_kinds(first: str, second: str) -> Maker:
    def make(folder: Path) -> Path:
        for index in range(COUNT // 2):
            write(folder / first.format(index), bgr(index))
            write(folder / second.format(index), bgr(index + COUNT))
        return folder

    return make


def kitti(folder: Path) -> Path:
    for index in range(COUNT):
        write(folder / f"image_2/{index:06d}.png", bgr(index))
        write(folder / f"image_3/{index:06d}.png", bgr(index))
    (folder / "times.txt").write_text("0\n0.1\n0.2\n0.3\n")
    return folder


def tartanair(folder: Path) -> Path:
    (folder / "depth_left").mkdir()
    for index in range(COUNT):
        write(folder / f"image_left/{index:06d}_left.png", bgr(index))
        np.save(folder / f"depth_left/{index:06d}_left_depth.npy", depth(index))
    return folder


def replica(folder: Path) -> Path:
    for index in range(COUNT):
        write(folder / f"results/frame{index:06d}.jpg", bgr(index))
        write(folder / f"results/depth{index:06d}.png", millimetres(index))
    return folder / "results"


def nyu(folder: Path) -> Path:
    for index in range(COUNT):
        write(folder / f"r-{1294886360 + index}.2-{index}.ppm", bgr(index))
        write(folder / f"d-{1294886360 + index}.2-{index}.pgm", millimetres(index).byteswap())
    return folder


def stray_scanner(folder: Path) -> Path:
    video([0.0, 0.1, 0.2, 0.3])(folder)
    for index in range(COUNT):
        write(folder / f"depth/{index:06d}.png", millimetres(index))
    (folder / "odometry.csv").write_text("timestamp, frame, x, y, z, qx, qy, qz, qw\n")
    return folder


def archive(folder: Path) -> Path:
    with zipfile.ZipFile(folder / "seq-01.zip", "w") as file:
        file.writestr("frame-000000.color.png", b"")
    return folder


def two_tracks(folder: Path) -> Path:
    """Colour, then depth, as the recorder of Azure Kinect has them."""
    path = folder / "walk.mkv"
    forms = (("mjpeg", "yuvj420p"), ("ffv1", "gray16le"))
    with av.open(str(path), "w") as container:
        tracks = []
        for codec, form in forms:
            track = container.add_stream(codec, rate=30)
            track.width, track.height, track.pix_fmt = 64, 48, form
            tracks.append(track)
        for index in range(COUNT):
            for track, (_, form) in zip(tracks, forms, strict=True):
                shade = np.full((48, 64, 3), 20 * index, np.uint8)
                frame = av.VideoFrame.from_ndarray(shade, format="rgb24").reformat(format=form)
                frame.pts = index
                container.mux(track.encode(frame))
        for track in tracks:
            container.mux(track.encode())
    return path


CAMERA_PARAMETERS = '{"camera": {"w": 32, "h": 24, "fx": 40, "scale": 5000.0}}'
OTHER_FOLDERS: dict[str, Maker] = {
    "OpenLORIS: `color/`, `aligned_depth/`, `depth/`": openloris,
    "Redwood: `rgb/NUMBER-MICROSECONDS.jpg`, `depth/`": redwood,
    "pictures that EXIF says to turn, with depth": turned,
    "`*.freiburg` beside depth without lists": with_text(
        numbered(pixels=fifths), livingRoom0__freiburg="0 0 0 0 0 0 0 1\n"
    ),
    "`cam_params.json` with another scale": with_text(
        numbered(pixels=fifths), cam_params__json=CAMERA_PARAMETERS
    ),
    "TartanAir's depth as RGBA PNG": packed_floats,
    "two cameras' pictures in one folder": two_kinds("left_{0}.png", "right_{0}.png"),
    "pictures and their masks in one folder": two_kinds("{0}.png", "{0}_mask.png"),
    "Replica: `results/`": replica,
    "KITTI odometry": kitti,
    "TartanAir": tartanair,
    "NYU raw": nyu,
    "Stray Scanner": stray_scanner,
    "a folder of archives": archive,
    "video of several tracks (Azure Kinect)": two_tracks,
}
