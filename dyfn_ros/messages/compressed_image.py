"""Colour images inside sensor_msgs/CompressedImage: JPEG and PNG, whatever `format` says."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from dyfn_ros.messages.encodings import (
    COLOUR_ENCODINGS,
    FULL_BITS,
    MessageError,
    Raster,
    decode_colour,
    quoted,
    to_uint8,
)
from dyfn_ros.messages.jpeg_complaints import harmless, with_complaints
from dyfn_ros.messages.picture_size import JPEG, MAX_PIXELS, PNG, check_picture_size

# What image_transport puts behind the name of an image.
TRANSPORTS = re.compile(r"/(compressed|compressedDepth|ffmpeg)$")
_LAYOUT = re.compile(
    r"^\s*(?:(?P<encoding>\w+)\s*;\s*)?(?P<codec>\w+)(?:\s+compressed\s*(?P<order>\w*))?"
)


@dataclass(frozen=True)
class Layout:
    """What `format` says: "rgb8; jpeg compressed bgr8", or just "jpeg".

    encoding: of the image before compression. order: of the channels that the codec was given.
    Empty where it says nothing.
    """

    encoding: str = ""
    codec: str = ""
    order: str = ""


def parse_format(text: str) -> Layout:
    """Anything is accepted: drivers write many things there."""
    match = _LAYOUT.match(text)
    return (
        Layout(**{key: value or "" for key, value in match.groupdict().items()})
        if match
        else Layout()
    )


def decode_compressed(
    message: Any,
    most: int = MAX_PIXELS,
    bits: int = FULL_BITS,
    damaged: Callable[[str], None] = lambda text: None,
) -> np.ndarray:
    """sensor_msgs/CompressedImage with JPEG or PNG -> H x W x 3 uint8 RGB.

    What the data is decides on the codec. `format` decides on what a file cannot say: whether a
    grey one is a Bayer mosaic, and whether the codec was given RGB where files have BGR.

    bits: of the values of 16-bit files, see decode_colour. damaged: told what is wrong with a JPEG
    whose picture is whole all the same.
    Raises MessageError for other codecs, depth transports, incomplete or broken files, and more
    pixels than `most`.
    """
    data, text = np.frombuffer(message.data, np.uint8), str(message.format)
    content = data.tobytes()
    _check_complete(content, text)
    check_picture_size(content, most)
    layout = parse_format(text)
    mosaic = layout.encoding.startswith("bayer_") and layout.order in ("", layout.encoding)
    try:
        image, complaints = _decoded(data, mosaic, bits, content.startswith(JPEG))
    except cv2.error as error:
        raise MessageError(f"the compressed image cannot be decoded: {error}") from error
    if image is None or image.size == 0:
        raise MessageError(f"the compressed image (format {quoted(text)}) cannot be decoded")
    for complaint in complaints:
        if not harmless(complaint):
            raise MessageError(f"the JPEG is damaged: {complaint}")
        damaged(f"the JPEG is damaged, but whole: {complaint}")
    if mosaic:
        return _demosaiced(image, layout, text, bits)
    image = to_uint8(image, bits)
    # What the codec was given as RGB comes back as RGB, in the places of BGR.
    if layout.order.startswith("rgb"):
        return np.ascontiguousarray(image)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _decoded(
    data: np.ndarray, mosaic: bool, bits: int, jpeg: bool
) -> tuple[np.ndarray | None, list[str]]:
    """-> as cv2.imdecode, and what libjpeg complains of."""
    kind = cv2.IMREAD_UNCHANGED if mosaic else cv2.IMREAD_COLOR
    if bits != FULL_BITS:
        kind |= cv2.IMREAD_ANYDEPTH

    def decode() -> np.ndarray | None:
        return cv2.imdecode(data, kind | cv2.IMREAD_IGNORE_ORIENTATION)

    return with_complaints(decode) if jpeg else (decode(), [])


def _demosaiced(image: np.ndarray, layout: Layout, text: str, significant: int) -> np.ndarray:
    bits = 8 * image.itemsize
    if (
        image.ndim != 2
        or layout.encoding not in COLOUR_ENCODINGS
        or f"{bits}" != layout.encoding[10:]
    ):
        raise MessageError(
            f"format {quoted(text)} needs a grey picture of its depth, the file has shape "
            f"{image.shape} of {image.dtype}"
        )
    height, width = image.shape
    rows = np.ascontiguousarray(image.astype(image.dtype.newbyteorder("<"), copy=False))
    return decode_colour(
        Raster(
            rows.reshape(-1).view(np.uint8),
            height,
            width,
            layout.encoding,
            width * image.itemsize,
            bits=significant,
        )
    )


def _check_complete(data: bytes, name: str) -> None:
    """Decoders fill what a cut-off file lacks with grey; that is no measurement."""
    if "compressedDepth" in name:
        raise MessageError(
            f"format {quoted(name)} is a depth image; expected a JPEG or PNG colour image"
        )
    if data.startswith(JPEG):
        complete = data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda")
    elif data.startswith(PNG):
        complete = b"IEND" in data[-64:]
    else:
        raise MessageError(
            f"the {len(data)} bytes (format {quoted(name)}) are neither JPEG nor PNG, the known "
            "formats"
        )
    if not complete:
        raise MessageError(
            f"the compressed image (format {quoted(name)}) ends early: {len(data)} bytes"
        )
