"""VOID: a hand-held camera with the sparse points and poses of a visual-inertial odometry.

Truth counts between 0.2 and 5 m, as VI-Depth scores it (Wofk et al. 2023, released evaluation).
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from dyfn_core.data.files import hidden, read_colour, read_uint16
from dyfn_core.data.frames import DataError, DataReport, FrameError
from dyfn_core.data.rgbd.cameras import FolderCamera, read_camera
from dyfn_core.data.rgbd.lists import read_poses
from dyfn_core.evaluation.benchmarks.sets.base import (
    UNREADABLE,
    BenchmarkFrame,
    BenchmarkSettings,
    BenchmarkSource,
    one_by_one,
)

EXPECTED = (
    "void_<density>/data/<sequence>/ with image/<stamp>.png, ground_truth/, sparse_depth/, "
    "validity_map/ (16-bit PNG, 256 a metre), absolute_pose/<stamp>.txt and K.txt, and "
    "void_<density>/test_image.txt, which lists the scored images"
)
# Truth is cut at 5 m below; predictions may be up to 8 m, as in the released evaluation.
SETTINGS = BenchmarkSettings(depth_max=8)
DENSITIES = (150, 500, 1500)
UNIT = 256.0  # stored values a metre
NEAREST, FARTHEST = 0.2, 5.0  # metres between which truth counts
LIST = "test_image.txt"


def open_void(root: Path, report: DataReport, density: int) -> list[BenchmarkSource]:
    """The test sequences of one density of sparse points.

    Every image of a sequence is run, as a stream would be; those in test_image.txt are scored.

    Args:
        root: The release, or its folder of this density.
        report: Counts what cannot be used; a sequence that lacks listed images as UNREADABLE.
        density: One of DENSITIES.

    Raises:
        DataError: The list holds something else.
    """
    name = f"void_{density}"
    folder = root if root.name == name else root / name
    listing = folder / LIST
    if not listing.is_file():
        if folder.is_dir():
            report.miss(f"folder without {LIST}", folder)
        return []
    found = []
    for sequence, scored in _listed(listing).items():
        reader = _Reader(folder / "data" / sequence, scored)
        absent = scored - {path.name for path in reader.images}
        if absent:
            text = f"{sequence} ({len(absent)} of {len(scored)} listed images are not there)"
            report.miss(UNREADABLE, text)
        if len(absent) < len(scored):
            numbers = list(range(len(reader.images)))
            found.append(BenchmarkSource(sequence, numbers, one_by_one(reader)))
    return found


def _listed(listing: Path) -> dict[str, set[str]]:
    """Names of the scored images of each sequence, in the order of the list."""
    found: dict[str, set[str]] = {}
    for line in listing.read_text("utf-8-sig").splitlines():
        parts = Path(line.strip()).parts
        if not parts:
            continue
        if len(parts) < 3 or parts[-2] != "image":
            raise DataError(
                f"{listing}: expected lines such as void_150/data/SEQUENCE/image/STAMP.png, "
                f"got {line!r}"
            )
        found.setdefault(parts[-3], set()).add(parts[-1])
    return found


class _Reader:
    """Reads a frame of one sequence by its place in the order of stamps."""

    def __init__(self, folder: Path, scored: set[str]) -> None:
        self.folder, self.scored = folder, scored
        names = [path for path in (folder / "image").glob("*.png") if not hidden(path)]
        self.images = sorted(names, key=_stamp)

    @cached_property
    def camera(self) -> FolderCamera:
        return read_camera(self.folder / "K.txt")

    def __call__(self, number: int) -> BenchmarkFrame:
        path = self.images[number]
        image, context = read_colour(path), path.name not in self.scored
        truth = np.full(image.shape[:2], np.nan, np.float32)
        if not context:
            truth = self._depth("ground_truth", path, image)
            truth[~((truth > NEAREST) & (truth < FARTHEST))] = np.nan
        sparse = self._depth("sparse_depth", path, image)
        sparse[read_uint16(self.folder / "validity_map" / path.name) == 0] = np.nan
        fx, fy, cx, cy = self.camera.at((image.shape[0], image.shape[1]))
        return BenchmarkFrame(
            image,
            truth,
            np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
            self._pose(path),
            stamp=_stamp(path),
            sparse=sparse,
            context=context,
        )

    def _depth(self, kind: str, image_path: Path, image: np.ndarray) -> np.ndarray:
        path = self.folder / kind / image_path.name
        stored = read_uint16(path)
        if stored.shape != image.shape[:2]:
            raise FrameError(
                f"{path}: depth of {stored.shape}, but the image has {image.shape[:2]}"
            )
        metres: np.ndarray = stored / np.float32(UNIT)
        metres[stored == 0] = np.nan
        return metres

    def _pose(self, image_path: Path) -> np.ndarray | None:
        """Camera to world; None where the odometry has none."""
        path = self.folder / "absolute_pose" / f"{image_path.stem}.txt"
        if not path.is_file():
            return None
        (pose,) = read_poses(path, DataReport(str(path)))
        return pose if np.isfinite(pose).all() else None


def _stamp(path: Path) -> float:
    """Seconds. Raises DataError for a file whose name is no stamp."""
    try:
        return float(path.stem)
    except ValueError as error:
        raise DataError(f"{path}: expected a name of seconds, such as 1552695.25.png") from error
