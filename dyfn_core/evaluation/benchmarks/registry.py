"""The public benchmarks of video depth by name, in their own layouts and in DepthCrafter's."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from dyfn_core.data.files import nothing_found
from dyfn_core.data.frames import DataError, DataReport
from dyfn_core.evaluation.benchmarks.sets import (
    bonn,
    depthcrafter,
    kitti,
    rgbd,
    scannet,
    seven_scenes,
    sintel,
    tum,
    void,
)
from dyfn_core.evaluation.benchmarks.sets.base import (
    UNREADABLE,
    Benchmark,
    BenchmarkFrame,
    BenchmarkSequence,
    BenchmarkSettings,
    BenchmarkSource,
    select,
)
from dyfn_core.evaluation.choices import AUTO, DEPTHCRAFTER, LAYOUTS, ORIGINAL

__all__ = [
    "BENCHMARKS",
    "LAYOUTS",
    "Benchmark",
    "BenchmarkFrame",
    "BenchmarkSequence",
    "BenchmarkSettings",
    "Opened",
    "benchmark",
    "open_benchmark",
]

_SINTEL = partial(Benchmark, expected=sintel.EXPECTED, settings=sintel.SETTINGS)
BENCHMARKS = {
    known.name: known
    for known in (
        _SINTEL(
            "sintel",
            "Sintel",
            open=sintel.open_sintel,
            sequences=tuple(sintel.LENGTHS),
            lengths=sintel.LENGTHS,
            video_set="sintel",
        ),
        _SINTEL(
            "sintel-final",
            "Sintel (final pass)",
            open=partial(sintel.open_sintel, render_pass="final"),
            sequences=tuple(sintel.LENGTHS),
            lengths=sintel.LENGTHS,
        ),
        Benchmark(
            "scannet",
            "ScanNet",
            scannet.EXPECTED,
            scannet.SETTINGS,
            scannet.open_scannet,
            scannet.SCENES,
            scannet.LENGTHS,
            "scannet",
        ),
        Benchmark(
            "kitti",
            "KITTI",
            kitti.EXPECTED,
            kitti.SETTINGS,
            kitti.open_kitti,
            kitti.DRIVES,
            video_set="KITTI",
        ),
        Benchmark(
            "bonn",
            "Bonn",
            bonn.EXPECTED,
            bonn.SETTINGS,
            bonn.open_bonn,
            bonn.SCENES,
            bonn.LENGTHS,
            "bonn",
        ),
        Benchmark("tum", "TUM RGB-D", tum.EXPECTED, tum.SETTINGS, tum.open_tum, video_set="tum"),
        Benchmark(
            "7scenes",
            "7-Scenes",
            seven_scenes.EXPECTED,
            seven_scenes.SETTINGS,
            seven_scenes.open_seven_scenes,
            seven_scenes.SEQUENCES,
            video_set="7scenes",
        ),
        *(
            Benchmark(
                f"void-{density}",
                f"VOID, {density} points",
                void.EXPECTED.replace("<density>", str(density)),
                void.SETTINGS,
                partial(void.open_void, density=density),
            )
            for density in void.DENSITIES
        ),
        Benchmark("rgbd", "RGB-D folder", rgbd.EXPECTED, rgbd.SETTINGS, rgbd.open_rgbd),
    )
}


@dataclass(frozen=True)
class Opened:
    """A benchmark's root that was opened.

    layout: "original" or "depthcrafter". missing: what a complete root has and this one lacks,
    each in words. report: files that cannot be used.
    """

    benchmark: Benchmark
    layout: str
    settings: BenchmarkSettings
    sequences: list[BenchmarkSequence]
    missing: list[str]
    report: DataReport


def benchmark(name: str) -> Benchmark:
    """The benchmark of this name. Raises DataError for an unknown one, with the nearest."""
    if name not in BENCHMARKS:
        near = difflib.get_close_matches(name.lower(), BENCHMARKS, n=1)
        hint = f", did you mean {near[0]!r}?" if near else ""
        raise DataError(f"unknown benchmark {name!r}{hint}; known: {', '.join(BENCHMARKS)}")
    return BENCHMARKS[name]


def open_benchmark(
    name: str,
    root: Path,
    settings: BenchmarkSettings | None = None,
    *,
    layout: str = AUTO,
    sequences: Sequence[str] = (),
    allow_missing: bool = False,
) -> Opened:
    """The sequences of a benchmark to score.

    settings: None for the benchmark's own (in DepthCrafter's layout first, stride and crop have
    been applied by who made the files). sequences: only these. allow_missing: score what is
    there. Raises DataError: nothing of the layout is there, or, unless allow_missing, something
    of a complete root is not, all listed.
    """
    known = benchmark(name)
    report = DataReport(f"{known.title} at {root}")
    found_layout, sources = _open(known, root, layout, report)
    if settings is None:
        settings = default_settings(known, found_layout)
    chosen = [select(source, settings) for source in sources]
    missing = _missing(known, chosen, settings, sequences)
    missing += report.problems.get(UNREADABLE, [])
    chosen = [s for s in chosen if len(s) and (not sequences or s.name in sequences)]
    if not sequences and known.sequences:
        extra = [s.name for s in chosen if s.name not in known.sequences]
        chosen = [s for s in chosen if s.name in known.sequences]
        for other in extra:
            report.miss("sequence that is not part of the benchmark", other)
    report.sequences, report.frames = len(chosen), sum(map(len, chosen))
    if not chosen or (missing and not allow_missing):
        raise DataError(_complaint(known, root, missing, bool(chosen)))
    return Opened(known, found_layout, settings, chosen, missing, report)


def default_settings(known: Benchmark, layout: str) -> BenchmarkSettings:
    """The paper's settings; what DepthCrafter's files have already had done to them is left out."""
    if layout == DEPTHCRAFTER:
        return replace(known.settings, first=0, stride=1, crop=(0, 0))
    return known.settings


def find_layout(known: Benchmark, root: Path, layout: str) -> str:
    """The layout that `auto` stands for. Raises DataError for an unknown one."""
    if layout not in LAYOUTS:
        raise DataError(f"unknown layout {layout!r}, expected one of {', '.join(LAYOUTS)}")
    if layout != AUTO:
        return layout
    if known.video_set and depthcrafter.video_folder(root, known.video_set):
        return DEPTHCRAFTER
    return ORIGINAL


def _open(
    known: Benchmark, root: Path, layout: str, report: DataReport
) -> tuple[str, list[BenchmarkSource]]:
    layout = find_layout(known, root, layout)
    expected = known.expected
    if layout == DEPTHCRAFTER:
        expected = depthcrafter.EXPECTED.replace("<set>", known.video_set or "<set>")
        folder = depthcrafter.video_folder(root, known.video_set) if known.video_set else None
        sources = [] if folder is None else depthcrafter.open_videos(folder, report)
        flat = {name.replace("/", "_"): name for name in known.sequences}
        sources = [replace(s, name=flat.get(s.name, s.name)) for s in sources]
    else:
        expected += f" (or {depthcrafter.EXPECTED})" if known.video_set else ""
        sources = known.open(root, report)
    if not sources:
        missed = f" ({report.summary()})" if report.problems else ""
        raise DataError(f"{nothing_found(root, expected)}{missed}")
    return layout, sources


def _missing(
    known: Benchmark,
    there: list[BenchmarkSequence],
    settings: BenchmarkSettings,
    only: Sequence[str],
) -> list[str]:
    """Sequences that are not there, and those with fewer frames than they should have."""
    by_name = {sequence.name: sequence for sequence in there}
    missing = [name for name in only or known.sequences if name not in by_name]
    for name, sequence in by_name.items():
        wanted = known.lengths.get(name, 0)
        if settings.frames is not None:
            wanted = min(wanted, settings.frames)
        if (not only or name in only) and (len(sequence) < wanted or not len(sequence)):
            missing.append(f"{name} ({len(sequence)} of {max(wanted, 1)} frames)")
    return missing


def _complaint(known: Benchmark, root: Path, missing: list[str], some: bool) -> str:
    hint = "; --allow-missing scores the rest" if some else ""
    return f"{root}: {known.title} is incomplete, missing: {', '.join(missing)}{hint}"
