"""RGB-D folders, pictures and videos in the forms that docs/recordings.md lists.

Each maker takes a folder that is empty and gives the path to open.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np

from tests.support.formats_of_bags import COUNT, Maker, millimetres
from tests.support.made_videos import make_video
from tests.support.numbered import depth, picture

TIMES = [1305031102.175304 + 0.033333 * index for index in range(COUNT)]
LATE = 0.0125  # seconds that TUM's depth is after its image
MATRIX = "40 0 15.5\n0 40 11.5\n0 0 1\n"
POSE = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
Pixels = Callable[[int], np.ndarray]


def write(path: Path, pixels: np.ndarray) -> None:
    """A picture in the format that the suffix names, whatever its case."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix.lower(), pixels)[1].tobytes())


def bgr(index: int) -> np.ndarray:
    return picture(index)[..., ::-1]


def numbered(
    colour: str = "rgb/{0}.png",
    truth: str = "depth/{0}.png",
    camera: str = "K.txt",
    matrix: str = MATRIX,
    pixels: Pixels = millimetres,
) -> Maker:
    """Files named by numbers, or by the times TIMES where the name has {1}, {2} for depth."""

    def make(folder: Path) -> Path:
        for index, time in enumerate(TIMES):
            names = index, f"{time:.6f}", f"{time + LATE:.6f}"
            write(folder / colour.format(*names), bgr(index))
            if truth:
                write(folder / truth.format(*names), pixels(index))
        (folder / camera).parent.mkdir(exist_ok=True)
        (folder / camera).write_text(matrix)
        return folder

    return make


def fifths(index: int) -> np.ndarray:
    return (5000 * depth(index)).astype(np.uint16)


def eighths(index: int) -> np.ndarray:
    return (10 * depth(index)).astype(np.uint8)


def with_text(make: Maker, **files: str) -> Maker:
    """The same with text files beside; of a name, __ is the dot."""

    def both(folder: Path) -> Path:
        make(folder)
        for name, text in files.items():
            (folder / name.replace("__", ".")).write_text(text)
        return folder

    return both


def lines(form: str) -> str:
    """A line a frame: {0} its number, {1} the image's time, {2} that of its depth."""
    return "".join(
        form.format(index, f"{time:.6f}", f"{time + LATE:.6f}") + "\n"
        for index, time in enumerate(TIMES)
    )


def tum(separator: str = " ", unit: str = "", late: float = 0.0) -> Maker:
    """unit: digits that make of seconds what the lists have. late: seconds more."""

    def stamps(extra: float) -> list[str]:
        times = [f"{time + extra:.6f}" for time in TIMES]
        return [time.replace(".", "") + unit if unit else time for time in times]

    def listed(folder: str, names: list[float], own: list[str]) -> str:
        pairs = zip(own, names, strict=True)
        return "".join(f"{at}{separator}{folder}/{time:.6f}.png\n" for at, time in pairs)

    rgb = listed("rgb", TIMES, stamps(0))
    truth = listed("depth", [time + LATE for time in TIMES], stamps(LATE + late))
    files = numbered("rgb/{1}.png", "depth/{2}.png", pixels=fifths)
    return with_text(files, rgb__txt=rgb, depth__txt=truth, groundtruth__txt="0 0 0 0 0 0 0 1\n")


def associated(name: str, form: str, colour: str = "rgb/{1}.png") -> Maker:
    truth = "depth/{2}.png" if "{1}" in colour else "depth/{0}.png"
    return with_text(numbered(colour, truth, pixels=fifths), **{name: lines(form)})


def frames(colour: str, truth: str, info: str = "") -> Maker:
    """Named as 7-Scenes' files, and exports of .sens files, are."""
    made = numbered(f"frame-{{0:06d}}.color.{colour}", f"frame-{{0:06d}}.depth.{truth}")
    return with_text(made, info__txt=info) if info else made


def arrays(folder: Path) -> Path:
    numbered(truth="")(folder)
    (folder / "depth").mkdir()
    for index in range(COUNT):
        np.save(folder / "depth" / f"{index}.npy", depth(index))
    return folder


def companions(folder: Path) -> Path:
    numbered()(folder)
    for name in ("rgb/._0.png", "rgb/.DS_Store", "depth/Thumbs.db", "depth/desktop.ini"):
        (folder / name).write_bytes(b"\0")
    (folder / "rgb" / "@eaDir").mkdir()
    return folder


def pointers(folder: Path) -> Path:
    numbered()(folder)
    for path in (folder / "depth").iterdir():
        path.write_text("version https://git-lfs.github.com/spec/v1\n")
    return folder


def pictures(truth: str) -> Maker:
    def make(folder: Path) -> Path:
        for index in range(COUNT):
            write(folder / f"{index}_color.png", bgr(index))
            if truth:
                write(folder / truth.format(index), millimetres(index))
        return folder

    return make


def euroc(folder: Path) -> Path:
    for index in range(COUNT):
        write(folder / f"mav0/cam0/data/{10**18 + index}.png", bgr(index)[..., 0])
    return folder


def video(times: list[float]) -> Maker:
    return lambda folder: make_video(folder / "walk.mp4", times)


def raw_stream(codec: str, suffix: str) -> Maker:
    """A stream of pictures without a container, which has no times."""

    def make(folder: Path) -> Path:
        path = folder / f"walk{suffix}"
        with av.open(str(path), "w", format=codec) as container:
            stream = container.add_stream({"h264": "libx264", "hevc": "libx265"}[codec], rate=30)
            stream.height, stream.width, stream.pix_fmt = 48, 64, "yuv420p"
            for index in range(COUNT):
                shade = np.full((48, 64, 3), 20 * index, np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(shade)))
            container.mux(stream.encode())
        return path

    return make


def replaced(make: Maker, name: str, data: bytes) -> Maker:
    """The same with something else in the place of a file."""

    def both(folder: Path) -> Path:
        make(folder)
        (folder / name).write_bytes(data)
        return folder

    return both


def no_video(data: bytes) -> Maker:
    def make(folder: Path) -> Path:
        (folder / "walk.mp4").write_bytes(data)
        return folder / "walk.mp4"

    return make


def elsewhere(folder: Path) -> Path:
    """Lists that were written where the pictures were before."""
    tum()(folder)
    for name in ("rgb", "depth"):
        table = folder / f"{name}.txt"
        table.write_text(table.read_text().replace(f" {name}/", f" /before/{name}/"))
    return folder


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n"
SENSOR = (
    "m_colorWidth = 32\nm_colorHeight = 24\nm_depthShift = 1000\n"
    "m_calibrationColorIntrinsic = 40 0 15.5 0 0 40 11.5 0 0 0 1 0 0 0 0 1\n"
)
TUM_LINE = "{1} rgb/{1}.png {2} depth/{2}.png"
ICL_LINE = "{0} depth/{0}.png {0} rgb/{0}.png"

FOLDERS: dict[str, Maker] = {
    "`rgb/`, `depth/`, `K.txt`": numbered(),
    "the same in other letters (`RGB/`, `Depth/`, `k.TXT`, `.PNG`)": numbered(
        "RGB/{0}.PNG", "Depth/{0}.PNG", "k.TXT"
    ),
    "`color/`, `colour/`, `image/` or `images/` beside `depth/`": numbered(
        "images/{0}.png", camera="intrinsics.txt"
    ),
    "names with prefixes (`rgb_7.png`, `depth_7.png`)": numbered(
        "rgb/rgb_{0}.png", "depth/depth_{0}.png"
    ),
    "names that are times, at most 0.02 s apart": numbered("rgb/{1}.png", "depth/{2}.png"),
    "TUM RGB-D, Bonn: `rgb.txt`, `depth.txt`": tum(),
    "TUM's lists with commas": tum(","),
    "TUM's lists in nanoseconds": tum(unit="000"),
    "TUM's lists, depth of another clock": tum(late=1000.0),
    "`associations.txt`": associated("associations__txt", TUM_LINE),
    "associations by another name": associated("fr1_desk__txt", TUM_LINE),
    "ICL-NUIM: depth first, frame numbers": associated(
        "associations__txt", ICL_LINE, "rgb/{0}.png"
    ),
    "7-Scenes": frames("png", "png"),
    "frames of a `.sens` file, with `info.txt`": frames("jpg", "pgm", SENSOR),
    "ScanNet export": with_text(
        numbered("color/{0}.jpg", camera="intrinsic/intrinsic_color.txt"),
    ),
    "hidden files, `Thumbs.db`": companions,
    "`K.txt` of another size": numbered(matrix="400 0 319.5\n0 400 239.5\n0 0 1\n"),
    "`K.txt` of an image half as large": numbered(matrix="20 0 7.5\n0 20 5.5\n0 0 1\n"),
    "`K.txt` of the image turned": numbered(matrix="40 0 11.5\n0 40 15.5\n0 0 1\n"),
    "`rgb.txt` as a Git LFS pointer": replaced(tum(), "rgb.txt", LFS),
    "`K.txt` as a Git LFS pointer": replaced(numbered(), "K.txt", LFS),
    "pictures in `rgb/` of another kind": numbered("rgb/{0}.webp"),
    "TUM's lists name files that are elsewhere": elsewhere,
    "`K.txt` transposed": numbered(matrix="40 0 0\n0 40 0\n15.5 11.5 1\n"),
    "depth as `.npy`, `.exr`, `.tiff`, `.jpg`": arrays,
    "depth as 8-bit PNG": numbered(pixels=eighths),
    "depth in `depth_png/` or the like": numbered(truth="depth_png/{0}.png"),
    "Git LFS pointers for depth": pointers,
    "a folder of pictures": pictures(""),
    "depth pictures among them": pictures("{0}_depth.png"),
    "EuRoC's `mav0/`": euroc,
    "video": video([0.0, 0.033, 0.066, 0.1]),
    "video of variable rate": video([0.0, 0.033, 0.3, 0.5]),
    "video: a Git LFS pointer": no_video(LFS),
    "video: a web page": no_video(b"<!DOCTYPE html><html></html>"),
    "raw H.264": raw_stream("h264", ".h264"),
    "raw H.265": raw_stream("hevc", ".265"),
}
