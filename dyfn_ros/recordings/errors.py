"""The error of everything that reads or writes recordings."""

from __future__ import annotations


class RecordingError(Exception):
    """A recording cannot be read or written; the message names the file or topic and why."""
