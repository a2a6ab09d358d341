"""Small copies of published data sets in their exact formats, of a scene known in closed form.

The scene, in metres, x right, y down, z forward: a floor at y = FLOOR, a ball, and sky.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import h5py
import numpy as np
import OpenEXR
from scipy.spatial.transform import Rotation

FLOOR = 1.5
BALL, RADIUS = np.array([0.4, 0.5, 6.0]), 1.0
PATCH = (slice(0, 8), slice(0, 12))  # pixels that the data sets mark as invalid


@dataclass(frozen=True)
class View:
    """What a loader must give back: image, depth (inf sky, NaN invalid), pixels' fx, fy, cx, cy
    with the first pixel's corner at 0, and camera to world in the scene's axes."""

    image: np.ndarray
    depth: np.ndarray
    camera: tuple[float, float, float, float]
    pose: np.ndarray


def pose(index: int) -> np.ndarray:
    """A camera that turns about all three axes and moves."""
    result = np.eye(4)
    turn = Rotation.from_euler("yxz", [6 * index - 5, 2 * index - 4, 3 * index], degrees=True)
    result[:3, :3] = turn.as_matrix()
    result[:3, 3] = [0.3 * index, -0.1 * index, 0.2 * index]
    return result


def view(index: int, size: tuple[int, int], camera: tuple[float, float, float, float]) -> View:
    """The scene seen by the index-th camera, as float64 depth along the optical axis."""
    height, width = size
    fx, fy, cx, cy = camera
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(size)], -1)
    where = pose(index)
    origin, directions = where[:3, 3], rays @ where[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = (FLOOR - origin[1]) / directions[..., 1]
        depth = np.where((floor > 0) & (floor < 90), floor, np.inf)
        a, b = (directions**2).sum(-1), directions @ (origin - BALL)
        root = b**2 - a * (((origin - BALL) ** 2).sum() - RADIUS**2)
        ball = (-b - np.sqrt(root)) / a
    depth = np.where((root > 0) & (ball > 0) & (ball < depth), ball, depth)
    seen = np.isfinite(depth)
    points = origin + directions * np.where(seen, depth, 0)[..., None]
    waves = 128 + 100 * np.sin(points * [1.1, 1.7, 0.9] + [0, 1, 2])
    image = np.where(seen[..., None], waves, [90, 140, 250]).astype(np.uint8)
    return View(image, depth, camera, where)


def write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = image[..., ::-1] if image.ndim == 3 else image
    assert cv2.imwrite(str(path), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])


def write_jpeg(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])
    assert done
    path.write_bytes(data.tobytes())


def write_exr(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = {"Y": values.astype(np.float32)}
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, channels) as file:
        file.write(str(path))


def float16_bits(values: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return values.astype(np.float16).view(np.uint16)


def with_patch(depth: np.ndarray, value: float) -> np.ndarray:
    """The depth with the invalid patch as a data set writes it."""
    result = depth.copy()
    result[PATCH] = value
    return result


@dataclass(frozen=True)
class MadeSet:
    """kind: of the data set. numbers: its frames, made from View 0, 1, 2. folder: of the
    sequence. depth_file: of a frame number. views: the truth. to_world: scene's axes -> the
    world's axes of the data set, None without poses. sky: whether it knows infinity. step:
    relative error that its storage of depth makes."""

    kind: str
    numbers: tuple[int, ...]
    depth_file: Callable[[int], Path]
    views: list[View]
    to_world: np.ndarray | None
    sky: bool
    step: float


NED = np.array(
    [[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
)  # of right, down, forward
THREE = range(3)


def make_irs(root: Path) -> MadeSet:
    folder = root / "Home" / "MadeHouse"
    views = [view(i, (540, 960), (480, 480, 480, 270)) for i in THREE]
    for number, shown in zip((9, 10, 11), views, strict=True):
        write_png(folder / f"l_{number:05d}.png", shown.image)
        write_png(folder / f"r_{number:05d}.png", shown.image[::-1])
        disparity = with_patch(0.1 * 480 / shown.depth, 0.3)  # below half a pixel
        write_exr(folder / f"d_{number:05d}.exr", disparity)
    return MadeSet(
        "irs", (9, 10, 11), lambda n: folder / f"d_{n:05d}.exr", views, None, False, 1e-5
    )


def make_point_odyssey(root: Path) -> MadeSet:
    folder = root / "train" / "made_walk"
    views = [view(i, (54, 96), (80, 82, 47.5, 28.5)) for i in THREE]
    matrices = []
    for number, shown in enumerate(views):
        write_jpeg(folder / "rgbs" / f"rgb_{number:05d}.jpg", shown.image)
        metres = np.minimum(with_patch(shown.depth, 0), 1000)
        stored = np.round(metres / 1000 * 65535).astype(np.uint16)
        write_png(folder / "depths" / f"depth_{number:05d}.png", stored)
        fx, fy, cx, cy = shown.camera
        matrices.append([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    extrinsics = np.linalg.inv(np.stack([shown.pose for shown in views]))
    np.savez(folder / "anno.npz", intrinsics=matrices, extrinsics=extrinsics, trajs_2d=[1.0])
    path = folder / "depths"
    return MadeSet(
        "point_odyssey",
        (0, 1, 2),
        lambda n: path / f"depth_{n:05d}.png",
        views,
        np.eye(4),
        True,
        0.008,
    )


def make_dynamic_replica(root: Path) -> MadeSet:
    base, name = root / "train", "made-1_obj"
    views = [view(i, (72, 128), (100, 100, 66, 35)) for i in THREE]
    entries = [_replica_entry(base, name, number, shown) for number, shown in enumerate(views)]
    right = {**entries[0], "camera_name": "right"}
    broken = json.loads(json.dumps(entries[0]).replace(name, "009850-3_obj_source"))
    for part in ("image", "depth"):
        write_png(base / broken[part]["path"], np.zeros((2, 2), np.uint16))
    text = json.dumps([entries[2], entries[0], right, entries[1], broken])
    (base / "frame_annotations_train.jgz").write_bytes(gzip.compress(text.encode()))
    folder = base / f"{name}_left" / "depths"
    return MadeSet(
        "dynamic_replica",
        (0, 1, 2),
        lambda n: folder / f"{name}_left_{n:04d}.geometric.png",
        views,
        np.eye(4),
        False,
        1e-3,
    )


def _replica_entry(base: Path, name: str, number: int, shown: View) -> dict[str, object]:
    image = f"{name}_left/images/{name}_left-{number:04d}.png"
    depth = f"{name}_left/depths/{name}_left_{number:04d}.geometric.png"
    write_png(base / image, shown.image)
    write_png(base / depth, float16_bits(with_patch(shown.depth, (0, np.inf, np.nan)[number])))
    fx, fy, cx, cy = shown.camera
    height, width = shown.depth.shape
    world_to_camera = np.linalg.inv(shown.pose)
    flip = np.diag([-1.0, -1, 1])  # PyTorch3D: x left, y up
    return {
        "sequence_name": name,
        "camera_name": "left",
        "frame_number": number,
        "image": {"path": image, "size": [height, width]},
        "depth": {"path": depth, "scale_adjustment": 1.0},
        "viewpoint": {
            "R": (flip @ world_to_camera[:3, :3]).T.tolist(),  # row vectors
            "T": (flip @ world_to_camera[:3, 3]).tolist(),
            "focal_length": [2 * fx / width, 2 * fy / height],
            "principal_point": [1 - 2 * cx / width, 1 - 2 * cy / height],
            "intrinsics_format": "ndc_norm_image_bounds",
        },
    }


def make_spring(root: Path) -> MadeSet:
    folder = root / "train" / "0007"
    views = [view(i, (1080, 1920), (1600, 1600, 960.5, 540.5)) for i in THREE]
    for number, shown in zip((1, 2, 3), views, strict=True):
        write_png(folder / "frame_left" / f"frame_left_{number:04d}.png", shown.image)
        disparity = np.full((2160, 3840), 77, np.float32)
        disparity[::2, ::2] = with_patch(1600 * 0.065 / shown.depth, np.nan)  # sky: 0
        path = folder / "disp1_left" / f"disp1_left_{number:04d}.dsp5"
        path.parent.mkdir(exist_ok=True)
        with h5py.File(path, "w") as file:
            file.create_dataset("disparity", data=disparity, compression="lzf")
    cameras = folder / "cam_data"
    cameras.mkdir()
    np.savetxt(cameras / "intrinsics.txt", [[1600, 1600, 960, 540]] * 3)
    extrinsics = [np.linalg.inv(shown.pose).reshape(-1) for shown in views]
    np.savetxt(cameras / "extrinsics.txt", extrinsics)
    path = folder / "disp1_left"
    return MadeSet(
        "spring",
        (1, 2, 3),
        lambda n: path / f"disp1_left_{n:04d}.dsp5",
        views,
        np.eye(4),
        True,
        1e-5,
    )


def make_midair(root: Path) -> MadeSet:
    climate = root / "Kite_training" / "sunny"
    views = [view(i, (1024, 1024), (512, 512, 512, 512)) for i in THREE]
    offset = np.arange(1024) + 0.5 - 512
    along = 512 / np.sqrt(offset[None] ** 2 + offset[:, None] ** 2 + 512**2)
    position, attitude = np.full((12, 3), 99.0), np.full((12, 4), 0.5)
    for number, shown in enumerate(views):
        name = f"trajectory_0003/{number:06d}"
        write_jpeg(climate / "color_left" / f"{name}.JPEG", shown.image)
        distance = with_patch(np.minimum(shown.depth / along, 1300.0), np.nan)
        write_png(climate / "depth" / f"{name}.PNG", float16_bits(distance))
        body = NED @ shown.pose @ np.linalg.inv(NED)  # forward, right, down
        x, y, z, w = Rotation.from_matrix(body[:3, :3]).as_quat()
        position[4 * number], attitude[4 * number] = body[:3, 3], [w, x, y, z]
    with h5py.File(climate / "sensor_records.hdf5", "w") as file:
        file["trajectory_0003/groundtruth/position"] = position
        file["trajectory_0003/groundtruth/attitude"] = attitude
    folder = climate / "depth" / "trajectory_0003"
    return MadeSet("midair", (0, 1, 2), lambda n: folder / f"{n:06d}.PNG", views, NED, True, 1e-3)


def make_ken_burns(root: Path) -> MadeSet:
    folder, depths = root / "made-walking", root / "made-walking-depth"
    degrees = (40.0, 60.0, 80.0)
    focals = [256 / np.tan(np.radians(angle / 2)) for angle in degrees]
    views = [view(i, (512, 512), (focals[i], focals[i], 256, 256)) for i in THREE]
    for number, shown in enumerate(views):
        for corner in ("bl", "br", "tl", "tr"):
            image = shown.image if corner == "bl" else shown.image[::-1]
            write_png(folder / f"{number:05d}-{corner}-image.png", image)
        (folder / f"{number:05d}-meta.json").write_text(json.dumps({"fltFov": degrees[number]}))
        centimetres = with_patch(100 * np.minimum(shown.depth, 700), 0)
        write_exr(depths / f"{number:05d}-bl-depth.exr", centimetres)
    return MadeSet(
        "ken_burns",
        (0, 1, 2),
        lambda n: depths / f"{n:05d}-bl-depth.exr",
        views,
        None,
        True,
        1e-5,
    )


def make_tartanair(root: Path) -> MadeSet:
    folder = root / "office" / "Easy" / "P000"
    views = [view(i, (480, 640), (320, 320, 320, 240)) for i in THREE]
    lines = []
    for number, shown in enumerate(views):
        write_png(folder / "image_left" / f"{number:06d}_left.png", shown.image)
        path = folder / "depth_left" / f"{number:06d}_left_depth.npy"
        path.parent.mkdir(exist_ok=True)
        metres = with_patch(np.minimum(shown.depth, 10000.0), 0)
        np.save(path, metres.astype(np.float32))
        body = NED @ shown.pose @ np.linalg.inv(NED)
        lines.append([*body[:3, 3], *Rotation.from_matrix(body[:3, :3]).as_quat()])
    np.savetxt(folder / "pose_left.txt", lines)
    path = folder / "depth_left"
    return MadeSet(
        "tartanair",
        (0, 1, 2),
        lambda n: path / f"{n:06d}_left_depth.npy",
        views,
        NED,
        True,
        1e-6,
    )


MAKERS: dict[str, Callable[[Path], MadeSet]] = {
    "irs": make_irs,
    "point_odyssey": make_point_odyssey,
    "dynamic_replica": make_dynamic_replica,
    "spring": make_spring,
    "midair": make_midair,
    "ken_burns": make_ken_burns,
    "tartanair": make_tartanair,
}
