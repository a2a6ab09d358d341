"""Files in the numeric order of their names, and pairs of colour and depth files by name."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

from dyfn_core.data.files import hidden

FIRST_TIME = 10**8  # numbers from here on are times, not frame numbers
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
    in the last number: the first of these rules that pairs the most files holds for all of them.
    A rule under which two files of a folder are alike is not used.
    """
    rules: tuple[Key, ...] = (
        lambda path: path.stem,
        lambda path: numbers_in(path) or None,
        lambda path: numbers_in(path)[-1:] or None,
    )
    return max((_by(rule, images, depths) for rule in rules), key=len)


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
