"""Depth images inside sensor_msgs/CompressedImage: 16-bit PNG and the compressedDepth transport."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from dyfn_ros.encodings import MessageError

_PNG = b"\x89PNG\r\n\x1a\n"
_HEADER = struct.Struct("<iff")  # compressedDepth: format, then A and B of z = A / (value - B)


def is_compressed_depth(message: Any) -> bool:
    """Whether a CompressedImage holds depth: by its format, or because it is a grey 16-bit PNG."""
    layout = str(message.format)
    if "compressedDepth" in layout or layout.startswith(("16UC1", "32FC1")):
        return True
    data = bytes(message.data[:26])
    return data.startswith(_PNG) and data[24:26] == b"\x10\x00"


def decode_compressed_depth(message: Any) -> np.ndarray:
    """CompressedImage with depth -> H x W float32 metres, NaN where there is none.

    16-bit PNG in millimetres, plain or as compressedDepth; compressedDepth of 32FC1 is inverse
    depth. Raises MessageError for anything else, naming the format.
    """
    layout, data = str(message.format), bytes(message.data)
    inverse: tuple[float, float] | None = None
    if "compressedDepth" in layout:
        if len(data) < _HEADER.size:
            raise MessageError(f"depth of format {layout!r} ends early: {len(data)} bytes")
        _, a, b = _HEADER.unpack_from(data)
        data = data[_HEADER.size :]
        inverse = (a, b) if layout.startswith("32FC1") else None
    values = _png16(layout, data)
    if inverse is None:
        metres = values.astype(np.float32) * np.float32(0.001)
    else:
        with np.errstate(divide="ignore"):
            metres = (inverse[0] / (values.astype(np.float32) - inverse[1])).astype(np.float32)
    valid = (values > 0) & np.isfinite(metres) & (metres > 0)
    return np.where(valid, metres, np.float32(np.nan))


def _png16(layout: str, data: bytes) -> np.ndarray:
    if not data.startswith(_PNG):
        raise MessageError(f"depth of format {layout!r}: expected a 16-bit PNG, found none")
    if b"IEND" not in data[-64:]:
        raise MessageError(f"depth of format {layout!r} ends early: {len(data)} bytes")
    try:
        values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise MessageError(f"depth of format {layout!r} cannot be decoded: {error}") from error
    if values is None or values.dtype != np.uint16 or values.ndim != 2:
        found = "nothing" if values is None else f"{values.dtype} {values.shape}"
        raise MessageError(f"depth of format {layout!r}: expected a 16-bit grey PNG, found {found}")
    return values
