"""Depth images inside sensor_msgs/CompressedImage: 16-bit PNG and the compressedDepth transport."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from dyfn_ros.messages.encodings import FULL, MessageError, metres_per_value
from dyfn_ros.messages.images import depth_fields
from dyfn_ros.messages.picture_size import PNG, check_picture_size
from dyfn_ros.messages.rvl import decode_rvl

_HEADER = struct.Struct("<iff")  # compressedDepth: format, then A and B of z = A / (value - B)


def is_compressed_depth(message: Any) -> bool:
    """Whether a CompressedImage holds depth: by its format, or because it is a grey 16-bit PNG."""
    layout = str(message.format)
    if "compressedDepth" in layout or layout.startswith(("16UC1", "32FC1")):
        return True
    data = bytes(message.data[:26])
    return data.startswith(PNG) and data[24:26] == b"\x10\x00"


def decode_compressed_depth(
    message: Any, scale: float | None = None, *, full: bool = False
) -> np.ndarray:
    """CompressedImage with depth -> H x W float32 metres, NaN where there is none.

    16-bit PNG in millimetres, plain or as compressedDepth, which may be RVL as well;
    compressedDepth of 32FC1 is inverse depth. scale: values per metre, instead of 1000, and 1 for
    32FC1. full: the largest value that 16 bits have is valid where they are depth. Raises
    MessageError for anything else, naming the format, and for more than MAX_PIXELS.
    """
    layout, data = str(message.format), bytes(message.data)
    inverse: tuple[float, float] | None = None
    if "compressedDepth" in layout:
        if len(data) < _HEADER.size:
            raise MessageError(f"depth of format {layout!r} ends early: {len(data)} bytes")
        _, a, b = _HEADER.unpack_from(data)
        data = data[_HEADER.size :]
        inverse = (a, b) if layout.startswith("32FC1") else None
    if "compressedDepth" in layout and layout.lower().rstrip().endswith("rvl"):
        values = _rvl(layout, data)
    else:
        values = _png16(layout, data)
    metres = values.astype(np.float32)
    if inverse is not None:
        with np.errstate(divide="ignore"):
            metres = (inverse[0] / (metres - inverse[1])).astype(np.float32)
    metres *= np.float32(metres_per_value("16UC1" if inverse is None else "32FC1", scale))
    valid = (values > 0) & np.isfinite(metres) & (metres > 0)
    if inverse is None and not full:
        valid &= values < FULL
    result: np.ndarray = np.where(valid, metres, np.float32(np.nan))
    return result


INVERSE_RESOLUTION = 100.0  # as compressed_depth_image_transport: depth_quantization
FARTHEST = 10.0  # and its depth_max, in the unit of the depth
# Depth is smooth: rows as differences to the row above are smaller at level 1 than without it at
# level 4, in half the time. OpenCV before 4.12 cannot be asked for them.
_UP = getattr(cv2, "IMWRITE_PNG_FILTER_UP", None)
PNG_OPTIONS = [cv2.IMWRITE_PNG_COMPRESSION, 1]
if _UP is not None:
    PNG_OPTIONS += [cv2.IMWRITE_PNG_FILTER, _UP]


def encode_compressed_depth(
    depth: np.ndarray, valid: np.ndarray, encoding: str = "32FC1", farthest: float = FARTHEST
) -> tuple[str, bytes]:
    """H x W depth and validity -> `format` and `data` of a compressedDepth CompressedImage.

    32FC1 becomes 16-bit inverse depth up to `farthest` (beyond it: invalid), with steps that grow
    with the square of the depth; 16UC1 thousandths of the unit, without loss.
    """
    if encoding == "16UC1":
        values = depth_fields(depth, valid, encoding)["data"].view("<u2").reshape(depth.shape)
        a = b = 0.0
    else:
        a = INVERSE_RESOLUTION * (INVERSE_RESOLUTION + 1.0)
        b = 1.0 - a / farthest
        # Nearer than this the 16 bits overflow.
        inside = valid & (depth < farthest) & (depth > a / (65535 - b))
        values = np.rint(np.where(inside, a / np.where(inside, depth, 1.0) + b, 0)).astype(
            np.uint16
        )
    ok, data = cv2.imencode(".png", values, PNG_OPTIONS)
    if not ok:
        raise MessageError(f"a depth image of {depth.shape} could not be compressed")
    return f"{encoding}; compressedDepth png", _HEADER.pack(0, a, b) + data.tobytes()


PRECISION = 2.5e-4  # largest relative error of encode_depth_range, up to RATIO
RATIO = 1 + 65_534 * 2 * PRECISION  # farthest over nearest depth; beyond it the error grows with it


def encode_depth_range(depth: np.ndarray, valid: np.ndarray) -> tuple[str, bytes, float]:
    """The same with a and b of this image's own range, so that no valid pixel is left out.

    Args:
        depth: H x W, in any unit.
        valid: H x W bool; depth is finite and positive there.

    Returns:
        `format`, `data`, and the largest relative error, at the farthest pixel: PRECISION, or
        farthest / nearest / 131 068 where that is more. Nearer pixels have less of it.

    Raises:
        MessageError: The image cannot be compressed.
    """
    found = depth[valid].astype(np.float64)
    near, far = (float(found.min()), float(found.max())) if found.size else (1.0, 1.0)
    steps = min((far / near - 1) / (2 * PRECISION), 65_534.0)
    a = steps / (1 / near - 1 / far) if far > near else far / (2 * PRECISION)
    a, b = (float(np.float32(value)) for value in (a, 1 - a / far))
    codes = np.rint(a / np.where(valid, depth.astype(np.float64), np.inf) + b)
    values = np.where(valid, codes.clip(1, 65_535), 0).astype(np.uint16)
    ok, data = cv2.imencode(".png", values, PNG_OPTIONS)
    if not ok:
        raise MessageError(f"a depth image of {depth.shape} could not be compressed")
    packed = _HEADER.pack(0, a, b) + data.tobytes()
    return "32FC1; compressedDepth png", packed, far / (2 * a)


def _rvl(layout: str, data: bytes) -> np.ndarray:
    try:
        return decode_rvl(data)
    except MessageError as error:
        raise MessageError(f"depth of format {layout!r}: {error}") from error


def _png16(layout: str, data: bytes) -> np.ndarray:
    if not data.startswith(PNG):
        raise MessageError(f"depth of format {layout!r}: expected a 16-bit PNG, found none")
    if b"IEND" not in data[-64:]:
        raise MessageError(f"depth of format {layout!r} ends early: {len(data)} bytes")
    check_picture_size(data)
    try:
        values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise MessageError(f"depth of format {layout!r} cannot be decoded: {error}") from error
    if values is None or values.dtype != np.uint16 or values.ndim != 2:
        found = "nothing" if values is None else f"{values.dtype} {values.shape}"
        raise MessageError(f"depth of format {layout!r}: expected a 16-bit grey PNG, found {found}")
    return values
