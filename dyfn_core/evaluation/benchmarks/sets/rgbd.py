"""RGB-D folders as benchmarks: any layout that the training loader of such folders knows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from dyfn_core.data.datasets.rgbd_folder import EXPECTED, Camera, open_rgbd_folder
from dyfn_core.data.files import folders_holding
from dyfn_core.data.frames import DataError, DataReport, FrameError, NumberedSequence
from dyfn_core.evaluation.benchmarks.sets.base import (
    UNREADABLE,
    Settings,
    Source,
    from_rgbd,
    one_by_one,
)

__all__ = ["EXPECTED", "SETTINGS", "open_rgbd", "rgbd_sources"]

SETTINGS = Settings()
LAYOUTS = ("rgb.txt", "frame-*.color.*", "color", "rgb")  # what tells each of them
NO_CUT = 1 << 40  # frames or seconds: a benchmark's sequence is one, whatever it lacks
LEVELS = 3  # folders below the root that are searched


def open_rgbd(root: Path, report: DataReport) -> list[Source]:
    """Every folder of a known layout, named by its path below the root."""
    found: dict[Path, Source] = {}
    for entry in LAYOUTS:
        for source in rgbd_sources(root, entry, report, named=str):
            found.setdefault(Path(source.name), source)
    named = root.resolve().name
    return [
        Source(_below(root, folder) or named, source.numbers, source.read)
        for folder, source in sorted(found.items())
    ]


def _below(root: Path, folder: Path) -> str:
    return "" if folder == root else folder.relative_to(root).as_posix()


def rgbd_sources(
    root: Path,
    entry: str,
    report: DataReport,
    *,
    named: Callable[[Path], str],
    intrinsics: Camera | None = None,
) -> list[Source]:
    """One source per folder that holds something matching `entry`, without cuts at gaps.

    named: folder -> the sequence's name. intrinsics: in pixels of the colour image, instead of
    the folder's own. A folder that cannot be read is counted in the report as UNREADABLE.
    """
    found = []
    for folder in folders_holding(root, entry, LEVELS):
        try:
            sequences = open_rgbd_folder(
                folder, report, intrinsics=intrinsics, max_gap=NO_CUT, max_missing=NO_CUT
            )
        except (DataError, FrameError) as error:
            report.miss(UNREADABLE, error)
            continue
        for sequence in sequences:
            if isinstance(sequence, NumberedSequence) and len(sequence):
                reader = sequence.reader
                read = one_by_one(lambda number, reader=reader: from_rgbd(reader(number)))  # type: ignore[misc]
                found.append(Source(named(folder), list(sequence.numbers), read))
    return found
