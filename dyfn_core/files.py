"""Files that appear under their name only when they are complete."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class OutputError(OSError):
    """An output cannot be written; the message names the file and why."""


@contextmanager
def finished_file(path: Path) -> Iterator[Path]:
    """A name to write to, which becomes `path` at the end, and is removed after an exception.

    An older file at `path` stays until then. Raises OutputError for an OSError.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        yield partial
        partial.replace(path)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise cannot_write(path, error) from error
        raise


def cannot_write(path: Path, error: OSError) -> OutputError:
    """The error that names the file; one that names it already stays as it is."""
    if isinstance(error, OutputError):
        return error
    return OutputError(f"{path}: cannot be written: {error.strerror or error}")
