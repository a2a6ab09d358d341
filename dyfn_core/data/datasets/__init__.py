"""The kinds of training data, by name: built in, and those that other packages add.

A package adds a kind by an entry point of the group `dyfn_core.data_kinds` that names a DataKind;
`dyfn_ros` adds `recording` in this way.
"""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, get_type_hints

from dyfn_core.data.datasets import (
    dynamic_replica,
    irs,
    ken_burns,
    midair,
    point_odyssey,
    rgbd_folder,
    spring,
    tartanair,
)
from dyfn_core.data.files import nothing_found
from dyfn_core.data.frames import DataError, DataReport, FrameSequence
from dyfn_core.data.posed import PosedRecording, posed_folders

ENTRY_POINTS = "dyfn_core.data_kinds"
RENDERED = "rendered"
AUTO = "auto"


@dataclass(frozen=True)
class DataKind:
    """How one kind of data is opened.

    open: (root, report, **options) -> the sequences, having counted in the report what cannot be
    used; its keyword-only parameters are the kind's options. expected: the layout, for messages.
    recognises: whether a path is of this kind without being told; None: it must be told. posed:
    (root, **options) -> the same as recordings with poses, in the order of time, with options of
    its own; None for kinds that are none.
    """

    name: str
    open: Callable[..., list[FrameSequence]]
    expected: str
    recognises: Callable[[Path], bool] | None = None
    posed: Callable[..., list[PosedRecording]] | None = None

    def options(self) -> dict[str, Any]:
        """Name -> (type, default) of each option."""
        return options_of(self.open)


def options_of(opener: Callable[..., Any]) -> dict[str, Any]:
    """Name -> (type, default) of the keyword-only parameters of a function."""
    hints = get_type_hints(opener)
    return {
        name: (hints[name], parameter.default)
        for name, parameter in inspect.signature(opener).parameters.items()
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY
    }


BUILT_IN = (
    DataKind("irs", irs.open_irs, irs.EXPECTED),
    DataKind("point_odyssey", point_odyssey.open_point_odyssey, point_odyssey.EXPECTED),
    DataKind("dynamic_replica", dynamic_replica.open_dynamic_replica, dynamic_replica.EXPECTED),
    DataKind("spring", spring.open_spring, spring.EXPECTED),
    DataKind("midair", midair.open_midair, midair.EXPECTED),
    DataKind("ken_burns", ken_burns.open_ken_burns, ken_burns.EXPECTED),
    DataKind("tartanair", tartanair.open_tartanair, tartanair.EXPECTED),
    DataKind(
        "rgbd_folder",
        rgbd_folder.open_rgbd_folder,
        rgbd_folder.EXPECTED,
        rgbd_folder.is_rgbd_folder,
        posed_folders,
    ),
)


@cache
def data_kinds() -> dict[str, DataKind | str]:
    """Every kind but `rendered`, by name; a text instead of a kind says why it cannot be had."""
    kinds: dict[str, DataKind | str] = {kind.name: kind for kind in BUILT_IN}
    for point in entry_points(group=ENTRY_POINTS):
        try:
            kinds[point.name] = point.load()
        except ImportError as error:
            package = point.value.partition(".")[0]
            kinds[point.name] = (
                f"{package} cannot be imported: {error}; "
                "`pip install rosbags mcap` for ROS recordings"
            )
    return kinds


def data_kind(name: str) -> DataKind:
    """The kind of this name. Raises DataError: unknown, with the nearest name, or not usable."""
    kinds = data_kinds()
    found = kinds.get(name)
    if found is None:
        names = [AUTO, RENDERED, *kinds]
        near = difflib.get_close_matches(name, names, n=1)
        hint = f", did you mean {near[0]!r}?" if near else ""
        raise DataError(f"unknown kind {name!r}{hint}; known: {', '.join(names)}")
    if isinstance(found, str):
        raise DataError(f"kind {name!r} cannot be used: {found}")
    return found


def recognise(root: Path) -> str:
    """The kind of an existing root that was given without one. Raises DataError for none."""
    if not root.exists():
        raise DataError(f"{root} does not exist")
    if (root / "frames").is_dir() or (root / "clips").is_dir():
        return RENDERED
    kinds = [kind for kind in data_kinds().values() if isinstance(kind, DataKind)]
    for kind in kinds:
        if kind.recognises is not None and kind.recognises(root):
            return kind.name
    unusable = [f"{name} ({why})" for name, why in data_kinds().items() if isinstance(why, str)]
    expected = "a rendered folder (frames/ or clips/), " + ", ".join(
        f"{kind.name} ({kind.expected})" for kind in kinds if kind.recognises
    )
    if unusable:
        expected += f"; not available: {', '.join(unusable)}"
    raise nothing_found(root, f"{expected}; other kinds must be named")


def open_kind(
    name: str, root: Path, options: dict[str, Any]
) -> tuple[list[FrameSequence], DataReport]:
    """The sequences below root, and the report on what could not be used.

    Raises DataError when there is not one usable frame, saying what was expected and, where
    something of the kind is there, what is wrong with it.
    """
    kind = data_kind(name)
    report = DataReport(f"{name} at {root}")
    sequences = [s for s in kind.open(root, report, **options) if len(s)]
    report.sequences, report.frames = len(sequences), sum(map(len, sequences))
    if not sequences:
        if report.problems:
            raise DataError(f"{report.summary()}; expected {kind.expected}")
        raise nothing_found(root, kind.expected)
    return sequences, report


def open_posed(root: Path, name: str, options: dict[str, Any]) -> list[PosedRecording]:
    """Recordings with poses below root.

    Args:
        root: A recording or a folder.
        name: The kind, or AUTO.
        options: Of the kind's `posed`.

    Raises:
        DataError: The kind has no poses, or has no such option; or nothing of it is there.
    """
    kind = recognise(root) if name == AUTO else name
    opener = None if kind == RENDERED else data_kind(kind).posed
    if opener is None:
        fit = [one.name for one in data_kinds().values() if isinstance(one, DataKind) and one.posed]
        raise DataError(
            f"{root}: {kind} is no recording with poses; expected one of {', '.join(fit)}"
        )
    known = options_of(opener)
    if unknown := sorted(options.keys() - known.keys()):
        raise DataError(f"{root}: {kind} has no option {unknown[0]!r}, only {sorted(known)}")
    found = opener(root, **options)
    if not found:
        raise nothing_found(root, data_kind(kind).expected)
    return found
