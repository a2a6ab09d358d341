"""Renders bags/demo: a wheeled robot drives through a home, with exact depth and noisy odometry.

    python bags/make_demo.py --assets FOLDER_WITH/BlendSwap-CC-0.sh3f --out bags/demo

Only the CC0 furniture library and this project's own procedural art go into it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from drive.daylight import Quality, bake
from drive.home import INSIDE, build_home
from drive.robot import RATE, Drive, Floor, mounting, planar_pose
from drive.route import STRIPS, the_drive

from dyfn_core.geometry.projection import back_project
from dyfn_core.metric.odometry_noise import OdometryNoise, noisy_poses
from dyfn_ros.recordings.rgbd_writer import in_nanoseconds
from dyfn_ros.recordings.typestore import Moved
from dyfn_ros.recordings.writer import RecordingWriter
from dyfn_worlds.camera.cameras import CameraLens, FreeSpace
from dyfn_worlds.render.occlusion import shade_corners
from dyfn_worlds.render.renderer import RenderCamera, Renderer, Shading
from dyfn_worlds.rooms.furniture import Showroom
from dyfn_worlds.scene.scene import Scene

LIBRARY = "BlendSwap-CC-0.sh3f"
SIZE = (240, 320)
VIEW = 70.0  # degrees across
FINER = 2  # rendered at this many times the size
SECTION = 20  # frames that are drawn with one choice of triangles
CELL = 0.4  # metres: triangles within one or two of them of what is seen may be seen
FPS, ODOMETRY_RATE = 10.0, 30.0
FIRST_STAMP, LATER = 1_700_000_000.0, 0.013  # images are not taken at the odometry's stamps
BRIGHTNESS, LAG = 112.0, 0.55  # of the mean pixel; share of an exposure's error kept each frame
NOISE = 1.2  # grey levels of the sensor
QUALITY = 76
ROBOT = (0.26, (0.12, 0.5, 0.95))  # radius and heights of what must not touch anything
ODOMETRY_NOISE = OdometryNoise(scale=0.02, distance=0.01, rotation=0.2, seed=0, planar=True)
WORLD, ODOM, BASE, CAMERA = "world", "odom", "base_link", "camera_optical_frame"


@dataclass(frozen=True)
class View:
    """One picture. image: H x W x 3 uint8; depth: H x W metres, inf outdoors; pose: 4 x 4."""

    image: np.ndarray
    depth: np.ndarray
    pose: np.ndarray


class Filmer:
    """Renders what the robot's camera sees, and exposes as a camera does."""

    def __init__(self, scene: Scene, drive: Drive, seed: int) -> None:
        self._renderer = Renderer((SIZE[0] * FINER, SIZE[1] * FINER))
        self._renderer.load(scene)
        self._scene, self._space = scene, FreeSpace(scene)
        self._lens = CameraLens.of_view(VIEW, SIZE)
        self._drive, self._rng = drive, np.random.default_rng([seed, 2])
        self._floor = Floor(np.random.default_rng([seed, 3]), [drive.reached(x) for x in STRIPS])

    def pose(self, seconds: float) -> np.ndarray:
        """4 x 4 camera to world."""
        base = planar_pose(self._drive.at(seconds))
        base[:3, :3] = base[:3, :3] @ self._floor.tilt(self._drive.distance(seconds))
        pose: np.ndarray = base @ mounting()
        return pose

    def film(self, times: np.ndarray) -> Iterator[View]:
        """The views of these times; the exposure follows the brightness with a lag."""
        exposure = 0.0
        for index, t in enumerate(times):
            if index % SECTION == 0:
                self._show_what_is_near(times[index : index + SECTION])
            exposure = exposure or self._settled(float(t))
            image, pose = self._shoot(float(t), exposure), self.pose(float(t))
            depth = self._renderer.draw(self._camera(float(t)), shrink=FINER).depth
            yield View(self._developed(image, depth), depth, pose)
            exposure *= (BRIGHTNESS / float(image.mean())) ** (2 * (1 - LAG))

    def _show_what_is_near(self, times: np.ndarray) -> None:
        """Leaves out what is far from everything that these frames see."""
        cells = {(0, 0, 0)}
        for t in times[:: SECTION // 5]:
            pose = self.pose(float(t))
            x, y = np.meshgrid(np.linspace(-1, 1, 120), np.linspace(-1, 1, 90))
            half = 0.52 / np.array(self._lens.focal)
            ways = np.stack([x * half[0], y * half[1], np.ones_like(x)], -1).reshape(-1, 3)
            ways = (ways / np.linalg.norm(ways, axis=1)[:, None]) @ pose[:3, :3].T
            origins = np.broadcast_to(pose[:3, 3], ways.shape)
            points = origins + ways * self._space.distance(origins, ways)[:, None]
            cells |= set(map(tuple, np.floor(points / CELL).astype(int)))
        steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), -1).reshape(-1, 3)
        near = np.unique((np.array([*cells])[:, None] + steps).reshape(-1, 3), axis=0)
        middles = self._scene.vertices["position"][self._scene.triangles].mean(axis=1)
        inside = ((middles > INSIDE[0]) & (middles < INSIDE[1])).all(axis=1)
        found = np.isin(_packed(np.floor(middles / CELL).astype(int)), _packed(near))
        shown = self._scene.triangles[found | ~inside]
        self._renderer.show(shown)

    def _settled(self, seconds: float) -> float:
        exposure = 4.0
        for _ in range(6):
            mean = float(self._shoot(seconds, exposure).mean())
            exposure *= (BRIGHTNESS / mean) ** 2
        return exposure

    def _shoot(self, seconds: float, exposure: float) -> np.ndarray:
        look = Shading(exposure, gloss=0.3, contrast=0.35)
        image = self._renderer.draw(self._camera(seconds), look).image
        squares = np.square(image, dtype=np.float32)
        return np.sqrt(cv2.resize(squares, SIZE[::-1], interpolation=cv2.INTER_AREA))

    def _camera(self, seconds: float) -> RenderCamera:
        return RenderCamera(self.pose(seconds), self._lens.focal)

    def _developed(self, image: np.ndarray, depth: np.ndarray) -> np.ndarray:
        noisy = image + self._rng.normal(0, NOISE, image.shape)
        clean = np.clip(noisy + 0.5, 0, 255).astype(np.uint8)
        return shade_corners(clean, depth, self._lens.focal[0], 0.35)

    def matrix(self) -> np.ndarray:
        """3 x 3 in pixels; ROS puts the first pixel's centre at 0, the renderer at half a pixel."""
        fx, fy = self._lens.focal
        height, width = SIZE
        return np.array(
            [[fx * width, 0, width / 2 - 0.5], [0, fy * height, height / 2 - 0.5], [0, 0, 1]]
        )


def _packed(cells: np.ndarray) -> np.ndarray:
    """N x 3 small integers -> N."""
    packed: np.ndarray = (cells + 1000) @ np.array([1, 4000, 16_000_000])
    return packed


def odometry(drive: Drive) -> list[tuple[float, Moved]]:
    """Time and message content, ODOMETRY_RATE times a second.

    The noise's random walks take a step at the camera's rate (see OdometryNoise); the messages
    between them follow the wheels. The covariances are those of the random walks.
    """
    times = np.arange(int(drive.seconds * ODOMETRY_RATE) + 1) / ODOMETRY_RATE
    true = [planar_pose(drive.at(t)) for t in times]
    every = round(ODOMETRY_RATE / FPS)
    walked = noisy_poses(true[::every], ODOMETRY_NOISE)
    origin = np.linalg.inv(true[0])
    poses, found, spread = [], [], np.zeros(6)
    for index, pose in enumerate(true):
        step = np.linalg.inv(true[index - index % every]) @ pose
        step[:3, 3] *= 1 + ODOMETRY_NOISE.scale
        poses.append(origin @ walked[index // every] @ step)
    for index, pose in enumerate(poses):
        step = np.linalg.inv(poses[max(index - 1, 0)]) @ pose
        length = float(np.linalg.norm(step[:3, 3]))
        spread[:2] += (ODOMETRY_NOISE.distance * length) ** 2 * every
        spread[5] += np.radians(ODOMETRY_NOISE.rotation) ** 2 * length
        rate = np.array([*step[:3, 3], 0, 0, np.arctan2(step[1, 0], step[0, 0])]) * ODOMETRY_RATE
        found.append((float(times[index]), _moved(pose, rate, spread, length)))
    return found


def _moved(pose: np.ndarray, rate: np.ndarray, spread: np.ndarray, length: float) -> Moved:
    """The unmeasured height, roll and pitch get the variance of a level floor."""
    level = np.array([0, 0, 1e-6, 1e-5, 1e-5, 0])
    of_rate = np.array([(0.01 * rate[0]) ** 2, 1e-6, 1e-6, 1e-5, 1e-5, 1e-5])
    return Moved(pose, rate, np.diag(spread + level + 1e-9), np.diag(of_rate + 1e-9))


def check_clearance(scene: Scene, drive: Drive) -> float:
    """Least metres between the robot and anything. Raises ValueError when it would touch."""
    space = FreeSpace(scene)
    turn = np.arange(24) * 2 * np.pi / 24
    ways = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(24)])
    radius, heights = ROBOT
    states = drive.states[:: round(RATE / 4)]
    origins = np.array([[x, y, z] for x, y, _ in states for z in heights])
    free = space.distance(np.repeat(origins, 24, axis=0), np.tile(ways, (len(origins), 1)))
    if free.min() < radius:
        at = origins[int(np.argmin(free)) // 24]
        raise ValueError(
            f"the robot would touch something at {np.round(at, 2)}: {free.min():.2f} m"
        )
    return float(free.min())


def record(out: Path, filmer: Filmer, drive: Drive) -> int:
    """Writes everything in the order of its stamps; -> images."""
    shots = np.arange(0.0, drive.seconds - LATER, 1 / FPS) + LATER
    moves, views, matrix = iter(odometry(drive)), filmer.film(shots), filmer.matrix()
    move = next(moves, None)
    with RecordingWriter(out, "mcap", overwrite=True) as writer:
        writer.write_static_transform(mounting(), in_nanoseconds(FIRST_STAMP), BASE, CAMERA)
        for seconds, view in zip([*shots, np.inf], chain(views, [None]), strict=True):
            while move is not None and move[0] <= seconds:
                _write_odometry(writer, move[1], in_nanoseconds(FIRST_STAMP + move[0]))
                move = next(moves, None)
            if view is not None:
                _write_view(writer, view, matrix, in_nanoseconds(FIRST_STAMP + seconds))
                print(f"\r{seconds:.1f} s", end="", file=sys.stderr, flush=True)
    return len(shots)


def _write_odometry(writer: RecordingWriter, moved: Moved, stamp: int) -> None:
    writer.write_odometry("/odom", moved, stamp, ODOM, BASE)
    writer.write_transform(moved.pose, stamp, ODOM, BASE)


def _write_view(writer: RecordingWriter, view: View, matrix: np.ndarray, stamp: int) -> None:
    writer.write_jpeg("/camera/image/compressed", view.image, stamp, CAMERA, QUALITY)
    writer.write_camera_info("/camera/camera_info", matrix, SIZE, stamp, CAMERA)
    depth = np.where(np.isfinite(view.depth), view.depth, 0.0)
    points = back_project(depth, matrix) @ view.pose[:3, :3].T + view.pose[:3, 3]
    # behind glass a depth camera sees nothing either
    depth[depth > 0] *= ((points > INSIDE[0]) & (points < INSIDE[1])).all(axis=1)
    writer.write_depth("/camera/depth/image/compressed", depth, stamp, CAMERA, "png")
    writer.write_pose("/ground_truth/pose", view.pose, stamp, WORLD)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--assets", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("bags/demo"))
    parser.add_argument("--seed", type=int, default=5, help="of small things, materials and noise")
    options = parser.parse_args()
    library = next(iter(sorted(options.assets.rglob(LIBRARY))), None)
    if library is None:
        parser.error(f"{options.assets}: no {LIBRARY} below it (Debian: sweethome3d-furniture)")
    home, drive = build_home(Showroom([library]), options.seed), the_drive()
    print(f"{drive.seconds:.1f} s, {drive.travelled[-1]:.1f} m, "
          f"{check_clearance(home.scene, drive):.2f} m from the nearest thing")  # fmt: skip
    rng = np.random.default_rng([options.seed, 1])
    scene = bake(home.scene, home.windows, home.lamps, home.sky, INSIDE, Quality(), rng)
    print(f"daylight in {len(scene.vertices)} vertices")
    count = record(options.out, Filmer(scene, drive, options.seed), drive)
    print(f"{options.out}: {count} frames")


if __name__ == "__main__":
    main()
