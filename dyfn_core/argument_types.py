"""Types of command-line arguments, with errors that say what was expected."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from typing import TypeVar

# In which library a model runs; auto is the fastest that is installed.
BACKENDS = ("torch", "auto", "onnxruntime", "openvino", "tensorrt", "compile")

_Number = TypeVar("_Number", int, float)


def _parsed(
    text: str, kind: Callable[[str], _Number], allowed: Callable[[_Number], bool], expected: str
) -> _Number:
    try:
        value = kind(text)
    except ValueError:
        value = None
    if value is None or not allowed(value):
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text!r}")
    return value


def at_least_one(text: str) -> int:
    """A whole number, 1 or more."""
    return _parsed(text, int, lambda value: value >= 1, "a whole number of 1 or more")


def not_negative(text: str) -> int:
    """A whole number, 0 or more."""
    return _parsed(text, int, lambda value: value >= 0, "a whole number of 0 or more")


def above_zero(text: str) -> float:
    """A number above 0, also infinity: no limit."""
    return _parsed(text, float, lambda value: value > 0, "a number above 0")


def finite_above_zero(text: str) -> float:
    """As above_zero, without infinity."""
    return _parsed(text, float, lambda value: 0 < value < math.inf, "a finite number above 0")


def finite(text: str) -> float:
    """A number that is not infinite."""
    return _parsed(text, float, math.isfinite, "a finite number")


def image_size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT -> (H, W)."""
    found = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT such as 1280x720, got {text!r}")
    return int(found[2]), int(found[1])


def device_name(text: str) -> str:
    """A name that models.resolve_device may know; whether it is here shows when it is used."""
    if not re.fullmatch(r"auto|cpu|(cuda|mps|xpu)(:\d+)?", text):
        raise argparse.ArgumentTypeError(f"expected auto, cpu, cuda or cuda:N, got {text!r}")
    return text
