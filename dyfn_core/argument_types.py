"""Types of command-line arguments, with errors that say what was expected."""

from __future__ import annotations

import argparse


def at_least_one(text: str) -> int:
    """A whole number, 1 or more."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} must be at least 1")
    return value


def not_negative(text: str) -> int:
    """A whole number, 0 or more."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} must not be negative")
    return value


def above_zero(text: str) -> float:
    """A number above 0, also infinity: no limit."""
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text} must be above 0")
    return value


def finite_above_zero(text: str) -> float:
    """As above_zero, without infinity."""
    value = above_zero(text)
    if value == float("inf"):
        raise argparse.ArgumentTypeError(f"{text} must be above 0")
    return value
