"""Small copies of the public benchmarks in their exact formats, of known values."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.data.rgbd.cameras import (
    PUBLISHED_SIZE,
    SEVEN_SCENES_CAMERA,
    SEVEN_SCENES_DEPTH,
    FolderCamera,
    laid_over,
)

PATCH = (slice(2, 6), slice(3, 9))  # pixels without truth


def depth(index: int, size: tuple[int, int]) -> np.ndarray:
    """Metres, float64: a slope that differs from frame to frame."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    return 2 + 0.1 * index + columns / size[1] + 2 * rows / size[0]


def image(index: int, size: tuple[int, int]) -> np.ndarray:
    """H x W x 3 uint8 RGB whose channels differ: red the frame's number, green and blue ramps."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    picture = np.zeros((*size, 3), np.uint8)
    picture[..., 0] = 40 + 20 * (index % 10)
    picture[..., 1] = 200 * columns // size[1]
    picture[..., 2] = 100 * rows // size[0]
    return picture


def pose(index: int) -> np.ndarray:
    """A camera that moves to the right and forward."""
    result = np.eye(4)
    result[:3, 3] = [0.1 * index, 0, 0.05 * index]
    return result


def write_image(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 98] if path.suffix == ".jpg" else []
    assert cv2.imwrite(str(path), picture[..., ::-1], quality)


def write_depth(path: Path, metres: np.ndarray, unit: float, invalid: int = 0) -> None:
    """16-bit PNG of `unit` values a metre, PATCH invalid."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = np.round(metres * unit).astype(np.uint16)
    stored[PATCH] = invalid
    assert cv2.imwrite(str(path), stored)


def write_matrix(path: Path, matrix: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, matrix)


def write_dpt(path: Path, metres: np.ndarray) -> None:
    """Sintel's depth: tag, width, height, float32 data; 1e11 in PATCH, as its sky."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = metres.astype("<f4")
    values[PATCH] = 1e11
    header = struct.pack("<fii", 202021.25, metres.shape[1], metres.shape[0])
    path.write_bytes(header + values.tobytes())


def write_cam(path: Path, matrix: np.ndarray, camera_to_world: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    world_to_camera = np.linalg.inv(camera_to_world)[:3]
    values = np.concatenate([matrix.ravel(), world_to_camera.ravel()]).astype("<f8")
    path.write_bytes(struct.pack("<f", 202021.25) + values.tobytes())


SINTEL_SIZE = (28, 64)
SINTEL_MATRIX = np.array([[70.0, 0, 31.5], [0, 70, 13.5], [0, 0, 1]])


def make_sintel(root: Path, lengths: dict[str, int]) -> None:
    base = root / "training"
    for name, frames in lengths.items():
        for i in range(frames):
            for kind in ("clean", "final"):
                path = base / kind / name / f"frame_{i + 1:04}.png"
                write_image(path, image(i + (kind == "final"), SINTEL_SIZE))
            write_dpt(base / "depth" / name / f"frame_{i + 1:04}.dpt", depth(i, SINTEL_SIZE))
            camera = base / "camdata_left" / name / f"frame_{i + 1:04}.cam"
            write_cam(camera, SINTEL_MATRIX, pose(i))


SCANNET_COLOUR, SCANNET_DEPTH = (242, 324), (120, 160)  # as 968 x 1296 and 480 x 640
SCANNET_CAMERA = (292.5, 293.0, 161.0, 121.0)  # of the colour image


def make_scannet(root: Path, scene: str, frames: int) -> None:
    """Frame 3 has a pose of -inf, as ScanNet's lost frames do."""
    folder = root / scene
    matrix = np.eye(4)
    matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = SCANNET_CAMERA
    write_matrix(folder / "intrinsic" / "intrinsic_color.txt", matrix)
    for i in range(frames):
        write_image(folder / "color" / f"{i}.jpg", image(i, SCANNET_COLOUR))
        write_depth(folder / "depth" / f"{i}.png", depth(i, SCANNET_DEPTH), 1000)
        where = np.full((4, 4), -np.inf) if i == 3 else pose(i)
        write_matrix(folder / "pose" / f"{i}.txt", where)


KITTI_SIZE = (30, 80)


def make_kitti(root: Path, drive: str, numbers: range) -> None:
    """Images from 0 on, truth only for `numbers`, as the first and last five have none."""
    date = drive[:10]
    for n in range(numbers.stop + 5):
        path = root / date / drive / "image_02" / "data" / f"{n:010}.png"
        write_image(path, image(n % 5, KITTI_SIZE))
    for n in numbers:
        path = root / "val" / drive / "proj_depth/groundtruth/image_02" / f"{n:010}.png"
        write_depth(path, depth(n, KITTI_SIZE), 256)
    numbers_of_p = "90.0 0 39.5 4.4 0 91.0 14.5 0.2 0 0 1 0.003"
    (root / date / "calib_cam_to_cam.txt").write_text(
        f"calib_time: 09-Jan-2012\nP_rect_02: {numbers_of_p}\n"
    )


TUM_SIZE = (24, 32)


def make_tum(folder: Path, frames: int, lost_depth: int | None = None) -> None:
    """TUM's layout, also Bonn's; depth lags by 4 ms, and one depth image may be lost."""
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for i in range(frames):
        stamp, later = 1311868164 + i / 30, 1311868164 + i / 30 + 0.004
        write_image(folder / f"rgb/{stamp:.6f}.png", image(i % 5, TUM_SIZE))
        lists["rgb"].append(f"{stamp:.6f} rgb/{stamp:.6f}.png")
        if i != lost_depth:
            write_depth(folder / f"depth/{later:.6f}.png", depth(i, TUM_SIZE), 5000)
            lists["depth"].append(f"{later:.6f} depth/{later:.6f}.png")
        x, _, z = pose(i)[:3, 3]
        lists["groundtruth"].append(f"{stamp:.4f} {x} 0 {z} 0 0 0 1")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(["# a comment", *lines]) + "\n")


def make_seven_scenes(folder: Path, frames: int) -> None:
    for i in range(frames):
        write_image(folder / f"frame-{i:06}.color.png", image(i, (24, 32)))
        write_depth(folder / f"frame-{i:06}.depth.png", depth(i, (24, 32)), 1000, invalid=65535)
        write_matrix(folder / f"frame-{i:06}.pose.txt", pose(i))


def over_colour(depth: np.ndarray) -> np.ndarray:
    """7-Scenes' depth where the colour image has it."""
    size = (depth.shape[0], depth.shape[1])
    cameras = [
        FolderCamera(camera, "7-Scenes", PUBLISHED_SIZE).at(size)
        for camera in (SEVEN_SCENES_DEPTH, SEVEN_SCENES_CAMERA)
    ]
    return laid_over(depth, *cameras)


def make_video(folder: Path, name: str, frames: int, size: tuple[int, int] = (48, 64)) -> None:
    """DepthCrafter's pair of files; truth of half the video's size, -1 where it is invalid."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}_rgb_left.mp4"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 15, (size[1], size[0]))
    assert video.isOpened()
    for i in range(frames):
        video.write(image(i, size)[..., ::-1])
    video.release()
    truth = np.stack([depth(i, (size[0] // 2, size[1] // 2)) for i in range(frames)])[:, None]
    truth[:, :, PATCH[0], PATCH[1]] = -1
    np.savez(folder / f"{name}_disparity.npz", disparity=truth)


VOID_SIZE = (24, 32)
VOID_CAMERA = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
VOID_SEQUENCE = "classroom0"


def make_void(release: Path, density: int, frames: int, scored: list[int]) -> Path:
    """One test sequence: a sparse point on every fourth pixel of every fourth row.

    The first of these is invalid by its map alone. Frame 1 has no pose. Frame i is at 100 + i / 30
    seconds; 9.9 s comes first in time and not by name.
    """
    folder = release / f"void_{density}"
    sequence = folder / "data" / VOID_SEQUENCE
    lines = []
    for i in range(frames):
        name = void_name(i)
        write_image(sequence / "image" / name, image(i, VOID_SIZE))
        write_depth(sequence / "ground_truth" / name, depth(i, VOID_SIZE), 256)
        points = np.zeros(VOID_SIZE)
        points[::4, ::4] = depth(i, VOID_SIZE)[::4, ::4]
        write_uint16(sequence / "sparse_depth" / name, np.round(points * 256))
        valid = np.where(points > 0, 256, 0)
        valid[0, 0] = 0
        write_uint16(sequence / "validity_map" / name, valid)
        if i != 1:
            write_matrix(sequence / "absolute_pose" / f"{name[:-4]}.txt", pose(i)[:3])
        if i in scored:
            lines.append(f"void_{density}/data/{VOID_SEQUENCE}/image/{name}")
    write_matrix(sequence / "K.txt", VOID_CAMERA)
    (folder / "test_image.txt").write_text("\n".join(lines) + "\n")
    return folder


def void_name(index: int) -> str:
    return f"{9.9 if index == 0 else 100 + index / 30:.4f}.png"


def write_uint16(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), values.astype(np.uint16))
