"""What libjpeg has to say of a file: it tells standard error only, and nobody who decodes."""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
import threading
from collections.abc import Callable
from typing import IO, TypeVar

T = TypeVar("T")

# The texts of libjpeg's warnings (jerror.h).
_COMPLAINTS = re.compile(
    rb"^(?:Corrupt JPEG data|Premature end of JPEG file|Inconsistent progression sequence"
    rb"|Invalid SOS parameters|Unsupported|Unknown Adobe|Warning: |Application transferred)"
)
# Webcams leave a few bytes before the end of a whole picture; a scan that ends early leaves more.
_HARMLESS = re.compile(r"^Corrupt JPEG data: [1-8] extraneous bytes before marker 0xd9$")
_turn = threading.Lock()


def harmless(complaint: str) -> bool:
    """Whether a picture is whole all the same."""
    return _HARMLESS.match(complaint) is not None


def with_complaints(decode: Callable[[], T]) -> tuple[T, list[str]]:
    """What a decoder gives, and what libjpeg had to complain of.

    Meanwhile standard error is a file; what others write there is passed on afterwards.
    """
    with _turn:
        try:
            kept = os.dup(2)
        except OSError:  # a process without standard error
            return decode(), []
        try:
            with _file() as caught:
                os.dup2(caught.fileno(), 2)
                try:
                    found = decode()
                finally:
                    os.dup2(kept, 2)
                caught.seek(0)
                return found, _complaints(caught.read())
        finally:
            os.close(kept)


def _file() -> IO[bytes]:
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("complaints"), "w+b")
    return tempfile.TemporaryFile()


def _complaints(written: bytes) -> list[str]:
    lines = written.splitlines(keepends=True)
    found = [line for line in lines if _COMPLAINTS.match(line)]
    if len(found) < len(lines):
        with contextlib.suppress(OSError):
            os.write(2, b"".join(line for line in lines if line not in found))
    return [line.decode("ascii", "replace").strip() for line in found]
