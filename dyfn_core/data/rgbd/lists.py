"""TUM's text files: lists of stamped files, associations of them, trajectories."""

from __future__ import annotations

import bisect
import re
from pathlib import Path
from typing import TypeVar

import numpy as np

from dyfn_core.data.files import read_table, usable_poses
from dyfn_core.data.frames import DataError, DataReport
from dyfn_core.geometry.rigid import quaternion_rotation, rigid

Thing = TypeVar("Thing")
Stamped = tuple[float, Path]


def stamped_files(path: Path, report: DataReport) -> list[Stamped]:
    """Lines `stamp file`, sorted by stamp; files that are not there are counted."""
    entries = []
    for line in _lines(path):
        match = re.fullmatch(r"([\d.eE+-]+)\s+(\S.*)", line)
        if not match:
            raise DataError(f"{path}: expected lines of `stamp file`, got {line!r}")
        entries.append((_number(match.group(1), path, line), path.parent / match.group(2)))
    return [entry for entry in sorted(entries) if _is_there(entry[1], path, report)]


def associated_files(path: Path, report: DataReport) -> list[tuple[float, Path, Path]]:
    """Lines `stamp file stamp file`, the colour file or the depth file first.

    Returns:
        The colour's stamp, the colour file and the depth file of each line, sorted; lines whose
        files are not there are counted.
    """
    rows = [line.split() for line in _lines(path)]
    for row in rows:
        if len(row) < 4:
            raise DataError(
                f"{path}: expected lines of `stamp file stamp file`, got {' '.join(row)!r}"
            )
    depth_first = [("depth" in row[1].lower(), "depth" in row[3].lower()) for row in rows]
    if len({first for first, _ in depth_first}) > 1 or any(a == b for a, b in depth_first):
        raise DataError(f"{path}: expected one file of each line, always the same, to name `depth`")
    colour, depth = (2, 0) if rows and depth_first[0][0] else (0, 2)
    entries = []
    for row in rows:
        image, other = path.parent / row[colour + 1], path.parent / row[depth + 1]
        there = [_is_there(file, path, report) for file in (image, other)]
        if all(there):
            entries.append((_number(row[colour], path, " ".join(row)), image, other))
    return sorted(entries)


def trajectory(path: Path, report: DataReport) -> list[tuple[float, np.ndarray]]:
    """Lines `stamp tx ty tz qx qy qz qw`: 4 x 4 camera to world, sorted by stamp."""
    rows = usable_poses(read_table(path, 8), path, report, slice(4, 8))
    rows = rows[np.isfinite(rows).all(1)]
    return [
        (stamp, rigid(quaternion_rotation(qw, qx, qy, qz), np.array([tx, ty, tz])))
        for stamp, tx, ty, tz, qx, qy, qz, qw in sorted(rows.tolist())
    ]


def nearest(entries: list[tuple[float, Thing]], stamp: float, tolerance: float) -> Thing | None:
    """The entry nearest to the stamp; None when it is farther than the tolerance."""
    place = bisect.bisect_left(entries, stamp, key=lambda entry: entry[0])
    beside = entries[max(0, place - 1) : place + 1]
    best = min(beside, key=lambda entry: abs(entry[0] - stamp), default=None)
    return None if best is None or abs(best[0] - stamp) > tolerance else best[1]


def _lines(path: Path) -> list[str]:
    try:
        lines = (line.strip() for line in path.read_text("utf-8-sig").splitlines())
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    return [line for line in lines if line and not line.startswith("#")]


def _number(text: str, path: Path, line: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise DataError(f"{path}: expected a stamp in seconds in {line!r}") from error


def _is_there(file: Path, path: Path, report: DataReport) -> bool:
    there = file.exists()
    if not there:
        report.miss(f"file named in {path.name} that is not there", file)
    return there
