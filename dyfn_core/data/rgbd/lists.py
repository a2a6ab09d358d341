"""TUM's text files: lists of stamped files, associations of them, trajectories."""

from __future__ import annotations

import re
from decimal import Decimal
from pathlib import Path

import numpy as np

from dyfn_core.data.files import numbers, read_table, usable_poses
from dyfn_core.data.frames import DataError, DataReport, FrameError
from dyfn_core.data.heads import told_by_head
from dyfn_core.data.rgbd.names import in_seconds
from dyfn_core.geometry.rigid import quaternion_rotation, rigid

Stamped = tuple[float, Path]
ABSENT = "that is not there"  # ends the reason of a file that is gone


def stamped_files(path: Path, report: DataReport) -> list[Stamped]:
    """Lines `stamp file`, sorted by stamp; files that are not there are counted.

    A comma may stand between them; stamps may be of ns, as in_seconds has it.
    """
    entries = []
    for line in _lines(path):
        match = re.fullmatch(r"([\d.eE+-]+)(?:\s*,\s*|\s+)(\S.*)", line)
        if not match:
            raise DataError(f"{path}: expected lines of `stamp file`, got {line!r}")
        entries.append((_stamp(match.group(1), path, line), _file(path, match.group(2))))
    return [entry for entry in sorted(entries) if _is_there(entry[1], path, report)]


def associated_files(path: Path, report: DataReport) -> list[tuple[float, Path, Path]]:
    """Lines `stamp file stamp file`, the colour file or the depth file first.

    Returns:
        The colour's stamp, the colour file and the depth file of each line, sorted; lines whose
        files are not there are counted.
    """
    rows = [re.split(r"\s*,\s*|\s+", line) for line in _lines(path)]
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
        image, other = _file(path, row[colour + 1]), _file(path, row[depth + 1])
        there = [_is_there(file, path, report) for file in (image, other)]
        if all(there):
            entries.append((_stamp(row[colour], path, " ".join(row)), image, other))
    return sorted(entries)


def read_poses(path: Path, report: DataReport) -> np.ndarray:
    """Camera to world, N x 4 x 4; NaN where a pose is none, which is counted.

    A line is a pose of 16 numbers (4 x 4), of 12 (3 x 4) or of 8 (`stamp tx ty tz qx qy qz qw`); or
    lines of 4 numbers are the rows of 4 x 4 or 3 x 4 matrices. Raises FrameError.
    """
    expected = f"{path}: expected lines of 16 (4 x 4), 12 (3 x 4) or 8 numbers (stamp t q)"
    table = numbers(path, expected)
    lines, columns = table.shape
    if columns == 4:
        last = table[3::4]
        none = ~np.isfinite(last).any(1, keepdims=True)  # a matrix that is no pose
        whole = lines % 4 == 0 and bool(((last == [0, 0, 0, 1]) | none).all())
        height = 4 if whole else 3
        if lines % height == 0:
            table = table.reshape(-1, height * 4)
    if table.shape[1] == 8:
        rows = usable_poses(table, path, report, slice(4, 8))
        return np.array([_posed(row[1:]) for row in rows]).reshape(-1, 4, 4)
    if table.shape[1] not in (12, 16):
        raise FrameError(f"{expected}, got {lines} lines of {columns}")
    rows = usable_poses(table, path, report)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, : rows.shape[1] // 4] = rows.reshape(len(rows), -1, 4)
    return poses


def _posed(row: np.ndarray) -> np.ndarray:
    """tx ty tz qx qy qz qw -> 4 x 4; all NaN for a row of NaN."""
    if not np.isfinite(row).all():
        return np.full((4, 4), np.nan)
    tx, ty, tz, qx, qy, qz, qw = row.tolist()
    return rigid(quaternion_rotation(qw, qx, qy, qz), np.array([tx, ty, tz]))


def trajectory(path: Path, report: DataReport) -> list[tuple[float, np.ndarray]]:
    """Lines `stamp tx ty tz qx qy qz qw`: 4 x 4 camera to world, sorted by stamp."""
    rows = usable_poses(read_table(path, 8), path, report, slice(4, 8))
    rows = rows[np.isfinite(rows).all(1)]
    return [(in_seconds(row[0]), _posed(np.array(row[1:]))) for row in sorted(rows.tolist())]


def _lines(path: Path) -> list[str]:
    try:
        lines = (line.strip() for line in path.read_text("utf-8-sig").splitlines())
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    if told := told_by_head(path):
        raise DataError(f"{path} is {told}")
    return [line for line in lines if line and not line.startswith("#")]


def _stamp(text: str, path: Path, line: str) -> float:
    try:
        return in_seconds(Decimal(text))
    except (ArithmeticError, ValueError) as error:
        raise DataError(f"{path}: expected a stamp in seconds in {line!r}") from error


def _file(path: Path, name: str) -> Path:
    """A file that a list names, also with the separators of another system."""
    file = path.parent / name
    return file if file.exists() else path.parent / name.replace("\\", "/")


def _is_there(file: Path, path: Path, report: DataReport) -> bool:
    there = file.exists()
    if not there:
        report.miss(f"file named in {path.name} {ABSENT}", file)
    return there
