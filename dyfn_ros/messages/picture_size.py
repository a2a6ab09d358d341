"""How large a JPEG or PNG says it is, read from its header before anything is decoded."""

from __future__ import annotations

import struct

from dyfn_ros.messages.encodings import MessageError

JPEG = b"\xff\xd8\xff"
PNG = b"\x89PNG\r\n\x1a\n"
MAX_PIXELS = 1 << 26  # 8192 x 8192; a hundred bytes can claim to be a picture of gigabytes

# Of a PNG's first chunk, after its length: IHDR, width, height.
_PNG_SIZE = struct.Struct(">4sII")
# Of a JPEG's start of frame, after its length: precision, height, width.
_JPEG_SIZE = struct.Struct(">BHH")
_NOT_FRAMES = (0xC4, 0xC8, 0xCC)  # C0 to CF are starts of frames, but for these tables
_ALONE = (0x01, *range(0xD0, 0xD9))  # markers without a length


def check_pixels(width: int, height: int, most: int = MAX_PIXELS) -> None:
    """Raises MessageError for a picture of more than so many pixels."""
    if width * height > most:
        raise MessageError(
            f"the picture says that it is {width} x {height} pixels; at most {most} "
            f"({most / (1 << 20):.4g} megapixels) are decoded"
        )


def check_picture_size(data: bytes, most: int = MAX_PIXELS) -> None:
    """data: of a JPEG or PNG file. Raises MessageError when its header says more pixels than
    `most`, or no size at all."""
    size = _png_size(data) if data.startswith(PNG) else _jpeg_size(data)
    if size is None:
        raise MessageError(
            f"the picture of {len(data)} bytes cannot be decoded: no header says its size"
        )
    check_pixels(*size, most)


def _png_size(data: bytes) -> tuple[int, int] | None:
    start = len(PNG) + 4
    if len(data) < start + _PNG_SIZE.size:
        return None
    name, width, height = _PNG_SIZE.unpack_from(data, start)
    return (width, height) if name == b"IHDR" else None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Of the first frame; like the decoders it skips what stands between two segments."""
    place = 2
    while (place := data.find(b"\xff", place)) >= 0 and place + 1 < len(data):
        marker = data[place + 1]
        place += 1
        if marker in (0x00, 0xFF) or marker in _ALONE:  # stuffing and fill bytes are no markers
            continue
        if 0xC0 <= marker <= 0xCF and marker not in _NOT_FRAMES:
            if len(data) < place + 3 + _JPEG_SIZE.size:
                return None
            _, height, width = _JPEG_SIZE.unpack_from(data, place + 3)
            return width, height
        place += 1 + int.from_bytes(data[place + 1 : place + 3], "big")
    return None
