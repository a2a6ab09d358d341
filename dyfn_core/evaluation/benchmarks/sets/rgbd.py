"""RGB-D folders as benchmarks: any layout that data.rgbd knows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from dyfn_core.data.datasets.rgbd_folder import whole_sequence
from dyfn_core.data.frames import DataError, DataReport, FrameError
from dyfn_core.data.rgbd.layouts import (
    EXPECTED,
    LAYOUTS,
    find_folders,
    layout_of,
    open_folder,
)
from dyfn_core.evaluation.benchmarks.sets.base import (
    UNREADABLE,
    BenchmarkSettings,
    BenchmarkSource,
    from_rgbd,
    one_by_one,
)

__all__ = ["EXPECTED", "SETTINGS", "open_rgbd", "rgbd_sources"]

SETTINGS = BenchmarkSettings()
LEVELS = 3  # folders below the root that are searched


def open_rgbd(root: Path, report: DataReport) -> list[BenchmarkSource]:
    """Every folder of a known layout, named by its path below the root."""

    def below(folder: Path) -> str:
        return root.resolve().name if folder == root else folder.relative_to(root).as_posix()

    return rgbd_sources(root, LAYOUTS, report, named=below)


def rgbd_sources(
    root: Path,
    layouts: tuple[str, ...],
    report: DataReport,
    *,
    named: Callable[[Path], str],
) -> list[BenchmarkSource]:
    """One source per folder of these layouts, without cuts at gaps.

    Args:
        root: searched, three levels deep.
        layouts: some of rgbd.layouts.LAYOUTS.
        report: counts what cannot be used; a folder that cannot be read as UNREADABLE.
        named: folder -> the sequence's name.
    """
    found = []
    for path in find_folders(root, LEVELS):
        if layout_of(path) not in layouts:
            continue
        try:
            sequence = whole_sequence(open_folder(path, report), report)
        except (DataError, FrameError) as error:
            report.miss(UNREADABLE, error)
            continue
        if sequence is not None:
            read = one_by_one(lambda number, reader=sequence.reader: from_rgbd(reader(number)))  # type: ignore[misc]
            found.append(BenchmarkSource(named(path), list(sequence.numbers), read))
    return found
