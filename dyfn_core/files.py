"""Files that appear under their name only when they are complete."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class OutputError(OSError):
    """An output cannot be written; the message names the file and why."""


@contextmanager
def finished_file(
    path: Path, *, durable: bool = False, previous: Path | None = None
) -> Iterator[Path]:
    """A name to write to, which becomes `path` at the end and is removed after an exception.

    An older file at `path` stays until then. Several processes may write one file at once: each
    writes under a name of its own, and the last one to finish wins.

    Args:
        path: the file to write.
        durable: flush the content to the disk before the file takes its name, so that a loss of
            power leaves the old file or the new one.
        previous: where the old file at `path` goes, if there is one, in the place of what is
            there. At every moment one of the two is whole.

    Raises:
        OutputError: for an OSError; it names the file.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        if durable:
            _flush(partial)
        if previous is not None and path.exists():
            path.replace(previous)
        partial.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):  # as a name that is too long; the first error says it
            partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise cannot_write(path, error) from error
        raise


def write_text(path: Path, text: str) -> None:
    """Write a small UTF-8 file as finished_file does. Raises OutputError."""
    with finished_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _flush(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def cannot_write(path: Path, error: OSError) -> OutputError:
    """The error that names the file; one that names it already stays as it is."""
    if isinstance(error, OutputError):
        return error
    return OutputError(f"{path}: cannot be written: {error.strerror or error}")
