"""Files in the numeric order of their names, and pairs of colour and depth files by name."""

from __future__ import annotations

import bisect
import re
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

from dyfn_core.data.files import hidden

FIRST_TIME = 10**8  # numbers from here on are times, not frame numbers
TOLERANCE = 0.02  # seconds between a colour frame and its depth or pose
_COUNTED = re.compile(r"\d{7}-(\d{12})")
Thing = TypeVar("Thing")
Key = Callable[[Path], Hashable]


def numbers_in(path: Path) -> tuple[Decimal, ...]:
    """The numbers in a file's name without its suffix; `1305031102.175304.png` has one."""
    return tuple(Decimal(text) for text in re.findall(r"\d+(?:\.\d+)?", path.stem))


def in_numeric_order(paths: Iterable[Path]) -> list[Path]:
    """Sorted by the numbers in the names: 9 before 10, times by value."""
    return sorted(paths, key=lambda path: (numbers_in(path), path.name))


def visible_files(folder: Path) -> list[Path]:
    """The files of a folder in numeric order, without hidden ones; [] without such a folder."""
    if not folder.is_dir():
        return []
    return in_numeric_order(path for path in folder.iterdir() if not hidden(path))


def entry(folder: Path, *names: str) -> Path:
    """The first of these entries that a folder has, in any case of letters when one is there.

    Args:
        folder: may not exist.
        names: as they are usual.

    Returns:
        `folder / names[0]` when there is none.
    """
    for name in names:
        if (folder / name).exists():
            return folder / name
    held = [path for path in folder.iterdir() if not hidden(path)] if folder.is_dir() else []
    for name in names:
        alike = [path for path in held if path.name.lower() == name.lower()]
        if len(alike) == 1:
            return alike[0]
    return folder / names[0]


def in_seconds(stamp: Decimal | float) -> float:
    """A stamp in s, ms, us or ns since 1970, told by its size, in seconds."""
    exact = Decimal(stamp)
    for digits, smaller in ((17, 9), (14, 6), (11, 3)):
        if abs(exact) >= Decimal(10) ** digits:
            return float(exact / Decimal(10) ** smaller)
    return float(exact)


def times_in(paths: Sequence[Path]) -> list[float] | None:
    """Seconds, by names that are times, or NUMBER-MICROSECONDS (Redwood); None when not all are."""
    counted = [_COUNTED.fullmatch(path.stem) for path in paths]
    if paths and all(counted):
        return [int(match.group(1)) * 1e-6 for match in counted if match]
    found = [numbers_in(path) for path in paths]
    if not all(len(numbers) == 1 and numbers[0] >= FIRST_TIME for numbers in found):
        return None
    return [in_seconds(numbers[0]) for numbers in found]


def frame_numbers(paths: Sequence[Path]) -> list[int]:
    """A number for each of these files, rising.

    The last number of each name where these are whole and rise, so that a missing frame leaves a
    gap; else (times, names without numbers) 0, 1, 2, ...
    """
    last = [numbers_in(path)[-1:] for path in paths]
    found = [int(numbers[0]) for numbers in last if numbers and numbers[0] % 1 == 0]
    rising = all(a < b for a, b in pairwise(found))
    if len(found) == len(paths) and rising and (not found or found[-1] < FIRST_TIME):
        return found
    return list(range(len(paths)))


def paired(images: Sequence[Path], depths: Sequence[Path]) -> dict[Path, Path]:
    """The depth file of each colour file that has one.

    Files belong together when their names agree without the suffix, or in all their numbers, or
    in the last number, or are times at most TOLERANCE apart: the first of these rules that pairs
    the most files holds for all of them. A rule under which two files of a folder are alike is not
    used.
    """
    rules: tuple[Key, ...] = (
        lambda path: path.stem,
        lambda path: numbers_in(path) or None,
        lambda path: numbers_in(path)[-1:] or None,
    )
    found = [_by(rule, images, depths) for rule in rules]
    return max([*found, _by_time(images, depths)], key=len)


def _by_time(images: Sequence[Path], depths: Sequence[Path]) -> dict[Path, Path]:
    ours, theirs = times_in(images), times_in(depths)
    if ours is None or theirs is None:
        return {}
    entries = sorted(zip(theirs, depths, strict=True))
    near = ((path, nearest(entries, at, TOLERANCE)) for at, path in zip(ours, images, strict=True))
    return {path: depth for path, depth in near if depth is not None}


def nearest(entries: list[tuple[float, Thing]], stamp: float, tolerance: float) -> Thing | None:
    """The entry nearest to the stamp; None when it is farther than the tolerance."""
    place = bisect.bisect_left(entries, stamp, key=lambda entry: entry[0])
    beside = entries[max(0, place - 1) : place + 1]
    best = min(beside, key=lambda entry: abs(entry[0] - stamp), default=None)
    return None if best is None or abs(best[0] - stamp) > tolerance else best[1]


def _by(rule: Key, images: Sequence[Path], depths: Sequence[Path]) -> dict[Path, Path]:
    keys = Counter(map(rule, images)), Counter(map(rule, depths))
    if any(count > 1 for found in keys for key, count in found.items() if key is not None):
        return {}
    depth_of = {rule(path): path for path in depths}
    return {
        path: depth_of[rule(path)]
        for path in images
        if rule(path) is not None and rule(path) in depth_of
    }
