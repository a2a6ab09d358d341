"""A walk along a textured plane whose depth PinholeModel reads, as a folder and as a bag."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from dyfn_core.geometry.rigid import between, inverse
from dyfn_ros.recordings.open import open_recording
from dyfn_ros.recordings.writer import RecordingWriter
from tests.support.odometry import MOUNT, SECOND, odometry
from tests.support.pinhole import FOV_X
from tests.support.textured_plane import CAMERA, SIZE, PlaneView, plane_view, texture, walk

UNIT = 3.0  # metres in one unit of the model
FOCAL = SIZE[1] / 2 / np.tan(np.radians(FOV_X / 2))
OWN_CAMERA = np.array([[FOCAL, 0, CAMERA[0, 2]], [0, FOCAL, CAMERA[1, 2]], [0, 0, 1]])


def shown(view: PlaneView) -> np.ndarray:
    """H x W x 3 uint8 RGB: red says the depth to PinholeModel, green has the texture."""
    image = np.zeros((*SIZE, 3), np.uint8)
    image[..., 0] = np.round((view.depth / UNIT - 0.5) * 255)
    image[..., 1] = view.image[..., 1]
    return image


def plane_folder(path: Path) -> Path:
    """60 frames at 10 Hz, see `shown`."""
    whole = texture()
    for name in ("rgb", "depth"):
        (path / name).mkdir(parents=True)
    np.savetxt(path / "K.txt", OWN_CAMERA)
    poses = walk(60, step=0.02, turn=0.002)
    np.savetxt(path / "poses.txt", np.stack(poses).reshape(-1, 16))
    for index, pose in enumerate(poses):
        view = plane_view(pose, whole, OWN_CAMERA)
        image = shown(view)[..., ::-1]
        cv2.imwrite(str(path / "rgb" / f"{index:05d}.png"), image)
        depth = np.round(view.depth * 1000).astype(np.uint16)
        cv2.imwrite(str(path / "depth" / f"{index:05d}.png"), depth)
    return path


def drive(
    folder: Path,
    path: Path,
    offset: float = 0.0,
    mount: np.ndarray = MOUNT,
    child: str = "base_link",
) -> Path:
    """The folder as a bag, its poses as a base's odometry between the images.

    offset: seconds of the odometry's clock. mount: the camera in the moving frame, child.
    """
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4) @ inverse(mount)
    path.parent.mkdir(exist_ok=True)
    with RecordingWriter(path) as writer:
        for index, frame in enumerate(open_recording(folder).frames()):
            stamp, name = frame.stamp_ns, "camera_optical"
            assert frame.depth is not None
            writer.write_png("/camera/image", frame.image, stamp, name)
            writer.write_depth("/camera/depth", frame.depth, stamp, name)
            writer.write_camera_info("/camera/camera_info", OWN_CAMERA, SIZE, stamp, name)
            here = between(poses[index], poses[min(index + 1, len(poses) - 1)], 0.5)
            when = stamp / SECOND + 0.05
            message = odometry(here, when + offset, child=child)
            writer.write("/odom", "nav_msgs/msg/Odometry", message, round(when * SECOND))
    return path
