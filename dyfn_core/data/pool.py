"""The data sets of a run opened together: their sequences, and how often each is drawn."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from dyfn_core.data.datasets import AUTO, RENDERED, data_kind, open_kind, recognise
from dyfn_core.data.frames import (
    DataError,
    DataReport,
    FrameSequence,
    NumberedSequence,
)
from dyfn_core.data.rendered import SPLITS, list_shards

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class DataSpec:
    """One data set of a run.

    root: file or folder. kind: a name of `data_kinds`, "rendered", or "auto". weight: how often
    it is drawn relative to the others; None: as its share of all frames (for all or for none).
    split: what its frames are for, "train" (when None) or "held_out"; rendered folders say so
    themselves. cuts: numbers of frames that are the first after a cut, or "SEQUENCE:NUMBER" where
    there are several sequences. options: of the kind, (name, value) pairs.
    """

    root: Path
    kind: str = AUTO
    weight: float | None = None
    split: str | None = None
    cuts: tuple[int | str, ...] = ()
    options: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class DataPool:
    """sequences, the probability of drawing each, and a report on each data set."""

    sequences: list[FrameSequence]
    shares: np.ndarray
    reports: list[DataReport]


def open_pool(
    specs: Sequence[DataSpec], split: str, span: int = 1, rendered: Sequence[str] = ("clip",)
) -> DataPool:
    """All sequences of one split ("train" or "held_out") with `span` frames or more.

    rendered: the kinds of rendered folders to take. Rendered folders are listed anew each time,
    the others once a process. Raises FileNotFoundError when no sequence is long enough, DataError
    for a root or an option that does not fit its kind, or when only some sets have a weight.
    """
    if len({spec.weight is None for spec in specs}) > 1:
        raise DataError("give every data set a weight, or none of them")
    sequences: list[FrameSequence] = []
    shares: list[float] = []
    reports: list[DataReport] = []
    for spec in specs:
        found, report = _open(spec, split, rendered)
        kept = [sequence for sequence in found if len(sequence) >= span]
        reports.append(_report(report, found, kept, span))
        counts = np.array([len(sequence) for sequence in kept], np.float64)
        sequences += kept
        shares += list(counts if spec.weight is None else spec.weight * counts / counts.sum())
    total = sum(shares)
    if not total > 0:
        roots = ", ".join(str(spec.root) for spec in specs)
        raise FileNotFoundError(
            f"no sequence of split {split!r} with {span} frames or more under {roots}: "
            + "; ".join(report.summary() for report in reports)
        )
    for report in reports:
        _tell(report.summary(), bool(report.problems))
    return DataPool(sequences, np.array(shares) / total, reports)


@lru_cache(maxsize=256)
def _tell(summary: str, problems: bool) -> None:
    """To the log, once a process: pools are opened again and again."""
    logger.log(logging.WARNING if problems else logging.INFO, "%s", summary)


def _open(
    spec: DataSpec, split: str, rendered: Sequence[str]
) -> tuple[list[FrameSequence], DataReport]:
    kind = resolve(spec)
    if kind == RENDERED:
        shards = [shard for which in rendered for shard in list_shards(spec.root, which, split)]
        return list(shards), DataReport(f"{RENDERED} {' and '.join(rendered)} at {spec.root}")
    sequences, report = _open_once(replace(spec, kind=kind, weight=None, split=None))
    if (spec.split or SPLITS[0]) != split:
        return [], DataReport(report.name)
    return sequences, report


@lru_cache(maxsize=64)
def resolve(spec: DataSpec) -> str:
    """The kind of a data set, looked up when it is "auto". Raises DataError."""
    kind = recognise(spec.root) if spec.kind == AUTO else spec.kind
    if kind == RENDERED:
        if spec.cuts or spec.options or spec.split:
            raise DataError(f"{spec.root}: rendered folders take a root and a weight only")
        return kind
    known = data_kind(kind).options()
    unknown = [name for name, _ in spec.options if name not in known]
    if unknown:
        raise DataError(f"{spec.root}: {kind} has no option {unknown[0]!r}, only {sorted(known)}")
    return kind


@lru_cache(maxsize=64)
def _open_once(spec: DataSpec) -> tuple[list[FrameSequence], DataReport]:
    sequences, report = open_kind(spec.kind, spec.root, dict(spec.options))
    if spec.cuts:
        sequences = cut_sequences(sequences, spec.cuts)
    return sequences, report


def cut_sequences(
    sequences: Sequence[FrameSequence], cuts: Sequence[int | str]
) -> list[FrameSequence]:
    """Split at the named frames. Raises DataError for a cut that is in no sequence."""
    unused = set(cuts)
    result: list[FrameSequence] = []
    for sequence in sequences:
        if not isinstance(sequence, NumberedSequence):
            raise DataError(f"{sequence.name}: its frames have no numbers to cut at")
        mine = {}
        for cut in cuts:
            owner, _, number = str(cut).rpartition(":")
            if sequence.name.partition("[")[0].endswith(owner) and number.isdigit():
                mine[int(number)] = cut
        inside = mine.keys() & set(sequence.numbers)
        unused -= {mine[number] for number in inside}
        result += _pieces(sequence, inside)
    if unused:
        raise DataError(
            f"cuts {sorted(map(str, unused))} are at no frame of {len(sequences)} sequences; "
            "expected a frame's number, or SEQUENCE:NUMBER"
        )
    return result


def _pieces(sequence: NumberedSequence, cuts: Collection[int]) -> list[NumberedSequence]:
    places = [place for place, number in enumerate(sequence.numbers) if number in cuts]
    bounds = sorted({0, *places, len(sequence)})
    return [
        replace(sequence, name=f"{sequence.name}#{part}", numbers=sequence.numbers[start:stop])
        for part, (start, stop) in enumerate(pairwise(bounds))
    ]


def _report(
    report: DataReport, found: list[FrameSequence], kept: list[FrameSequence], span: int
) -> DataReport:
    """The report with the sequences counted that are too short for this run."""
    problems = {reason: list(names) for reason, names in report.problems.items()}
    short = [sequence.name for sequence in found if len(sequence) < span]
    if short:
        problems[f"sequence of fewer than {span} frames"] = short
    return DataReport(report.name, len(kept), sum(map(len, kept)), problems)
