"""Pictures by their headers."""

from __future__ import annotations

import struct
import zlib

from dyfn_ros.messages.picture_size import PNG


def png(width: int, height: int, bits: int = 8, colour: int = 2) -> bytes:
    """What its header says, and next to no pixels."""

    def chunk(name: bytes, data: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(name + data))
        return struct.pack(">I", len(data)) + name + data + check

    size = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    pixels = zlib.compress(bytes(100_000))
    return PNG + chunk(b"IHDR", size) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
