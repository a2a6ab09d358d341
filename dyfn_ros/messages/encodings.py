"""Raw pixel encodings of sensor_msgs/Image, decoded to arrays without cv_bridge.

Knows buffers and arrays only: no message types, no rclpy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

FULL_BITS = 16
FULL = (1 << FULL_BITS) - 1  # of 16-bit depth: beyond what can be said, or a word for none
_OF_TWELVE_BITS = 4095 // 257  # what is left of them when 16 bits become 8
_SHOWN = 40  # characters of a name that a message made up


class MessageError(ValueError):
    """A message whose content cannot be used; says what was expected."""


def quoted(text: str) -> str:
    """A name of a message, as Python writes it, and no longer than a line bears."""
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")


@dataclass(frozen=True)
class Raster:
    """The raw image of a message.

    data: 1-D uint8, as it came.
    step: bytes from one row to the next; any value of at least one row's bytes.
    bits: that the values of 16-bit encodings have.
    """

    data: np.ndarray
    height: int
    width: int
    encoding: str
    step: int
    big_endian: bool = False
    bits: int = FULL_BITS

    def dtype(self, kind: str) -> np.dtype:
        return np.dtype((">" if self.big_endian else "<") + kind)


def _check_size(raster: Raster) -> None:
    if raster.height < 1 or raster.width < 1:
        raise MessageError(
            f"the image is {raster.width} x {raster.height} pixels; both must be at least 1"
        )


def _plane(raster: Raster, start: int, rows: int, row_bytes: int, stride: int) -> np.ndarray:
    """rows x row_bytes uint8 view of one plane, without the padding of its rows."""
    return np.lib.stride_tricks.as_strided(
        raster.data[start:], shape=(rows, row_bytes), strides=(stride, 1), writeable=False
    )


def _check_buffer(raster: Raster, row_bytes: int, full: int, last_padding: int) -> None:
    """full: bytes that step and height make; drivers may leave the last row's padding away."""
    if raster.step < row_bytes:
        raise MessageError(
            f"step is {raster.step} bytes, but a row of {raster.width} pixels of "
            f"{raster.encoding} has {row_bytes}"
        )
    if raster.data.size not in (full, full - last_padding):
        raise MessageError(
            f"data has {raster.data.size} bytes, but {raster.height} rows of step {raster.step} "
            f"({raster.encoding}, {raster.width} pixels wide) make {full}"
        )


def _rows(raster: Raster, kind: str, channels: int) -> np.ndarray:
    """H x W x channels in the machine's byte order, for one plane of interleaved pixels."""
    dtype = raster.dtype(kind)
    row_bytes = raster.width * channels * dtype.itemsize
    _check_buffer(raster, row_bytes, raster.step * raster.height, raster.step - row_bytes)
    rows = np.ascontiguousarray(_plane(raster, 0, raster.height, row_bytes, raster.step))
    pixels = rows.view(dtype).reshape(raster.height, raster.width, channels)
    return pixels.astype(dtype.newbyteorder("="), copy=False)


def to_uint8(pixels: np.ndarray, bits: int = FULL_BITS) -> np.ndarray:
    """16-bit values of so many significant bits to 8 bit, rounded; 8 bit as it is."""
    if pixels.dtype == np.uint8:
        return pixels
    if bits != FULL_BITS:
        most = (1 << bits) - 1
        values = np.minimum(pixels, most).astype(np.uint32)
        scaled: np.ndarray = ((values * 255 + most // 2) // most).astype(np.uint8)
        return scaled
    return ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)


def doubted_bits(encoding: str, image: np.ndarray, bits: int = FULL_BITS) -> str:
    """Drivers put 10 or 12 bits into 16-bit encodings, whose pictures are then dark.

    encoding: or the format of a CompressedImage, whose JPEGs have 8 bits.
    image: H x W x 3 uint8 as it was decoded. bits: that its values were taken to have.
    -> what is doubted, empty for nothing.
    """
    wide = "16" in encoding and "jpeg" not in encoding
    if bits != FULL_BITS or not wide or not 0 < image.max() <= _OF_TWELVE_BITS:
        return ""
    return f"the values of {quoted(encoding)} are below 4096 of 65536; if the camera gives 12 bits"


def _decode_packed(raster: Raster, kind: str, channels: int, to_rgb: int | None) -> np.ndarray:
    """to_rgb: OpenCV's conversion code; None when it is RGB already."""
    pixels = to_uint8(_rows(raster, kind, channels), raster.bits)
    return pixels.copy() if to_rgb is None else cv2.cvtColor(pixels, to_rgb)


def _decode_float(raster: Raster) -> np.ndarray:
    pixels = _rows(raster, "f4", 1)[..., 0]
    valid = ~np.isnan(pixels)
    if np.any((pixels[valid] < 0) | (pixels[valid] > 1)):
        raise MessageError("a 32FC1 colour image must have its values in 0..1 (NaN is black)")
    grey = np.rint(np.where(valid, pixels, 0) * 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


_DEMOSAIC = {
    "rggb": cv2.COLOR_BayerRGGB2RGB,
    "bggr": cv2.COLOR_BayerBGGR2RGB,
    "gbrg": cv2.COLOR_BayerGBRG2RGB,
    "grbg": cv2.COLOR_BayerGRBG2RGB,
}


def _decode_bayer(raster: Raster, kind: str, pattern: str) -> np.ndarray:
    """Bilinear; every sample of the sensor keeps its value.

    OpenCV copies the outermost ring from the next one; mirroring first (which keeps the pattern)
    gives the border its own samples back.
    """
    if raster.height < 2 or raster.width < 2:
        raise MessageError(
            f"{raster.encoding} needs at least 2 x 2 pixels, not {raster.width} x {raster.height}"
        )
    mosaic = _rows(raster, kind, 1)[..., 0]
    mirrored = cv2.copyMakeBorder(mosaic, 2, 2, 2, 2, cv2.BORDER_REFLECT_101)
    rgb = cv2.cvtColor(mirrored, _DEMOSAIC[pattern])[2:-2, 2:-2]
    return np.ascontiguousarray(to_uint8(rgb, raster.bits))


# ITU-R BT.601, limited range, as cameras and V4L2 mean it.
_YUV_TO_RGB = np.array(
    [[1.164384, 0, 1.596027], [1.164384, -0.391762, -0.812968], [1.164384, 2.017232, 0]]
)
_YUV_OFFSET = -_YUV_TO_RGB @ np.array([16.0, 128.0, 128.0])


def _yuv_to_rgb(y: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    yuv = np.stack([np.maximum(y, 16), u, v], axis=2)
    return cv2.transform(yuv, np.column_stack([_YUV_TO_RGB, _YUV_OFFSET])).reshape(yuv.shape)


def _check_even(raster: Raster, height_too: bool) -> None:
    if raster.width % 2 or (height_too and raster.height % 2):
        what = "width and height" if height_too else "width"
        raise MessageError(
            f"{raster.encoding} needs an even {what}, not {raster.width} x {raster.height}"
        )


def _decode_yuv422(raster: Raster, luma: int, chroma: int) -> np.ndarray:
    """luma, chroma: offset of the first Y and of U in the four bytes of two pixels."""
    _check_even(raster, height_too=False)
    quads = _rows(raster, "u1", 2).reshape(raster.height, raster.width // 2, 4)
    y = quads[..., luma::2].reshape(raster.height, raster.width)
    u = np.repeat(quads[..., chroma], 2, axis=1)
    v = np.repeat(quads[..., chroma + 2], 2, axis=1)
    return _yuv_to_rgb(y, u, v)


def _luma_stride(raster: Raster, tight: int) -> int:
    """Bytes from one row of Y to the next.

    Some drivers set step to the bytes of all planes per row; that is clear when the whole
    buffer is that long and has no padding at all (tight: its bytes then).
    """
    if raster.data.size == tight == raster.step * raster.height:
        return raster.width
    return raster.step


def _luma_420(raster: Raster, planes: int) -> tuple[np.ndarray, int]:
    """Y plane, and the stride of its rows, of an image whose chroma has half the resolution.

    planes: that the chroma has; its rows are that much shorter, and so is their padding.
    """
    _check_even(raster, height_too=True)
    h, w = raster.height, raster.width
    stride = _luma_stride(raster, tight=w * h * 3 // 2)
    if stride == raster.step:
        padding = (stride - w) // planes
        _check_buffer(raster, w, full=stride * h * 3 // 2, last_padding=padding)
    return _plane(raster, 0, h, w, stride), stride


def _decode_nv(raster: Raster, u: int) -> np.ndarray:
    """Y plane, then pairs at half the resolution both ways, in rows of the same step.

    u: place of U in a pair.
    """
    y, stride = _luma_420(raster, planes=1)
    h, w = raster.height, raster.width
    pairs = _plane(raster, h * stride, h // 2, w, stride).reshape(h // 2, w // 2, 2)
    pairs = pairs.repeat(2, axis=0).repeat(2, axis=1)
    return _yuv_to_rgb(y, pairs[..., u], pairs[..., 1 - u])


def _decode_planar(raster: Raster, u: int) -> np.ndarray:
    """Y plane, then U and V planes at half the resolution both ways, in rows of half the step.

    u: 0 when U comes before V, else 1.
    """
    if raster.step % 2:
        raise MessageError(f"{raster.encoding} needs an even step, not {raster.step}")
    y, stride = _luma_420(raster, planes=2)
    h, w = raster.height, raster.width
    size = stride // 2 * (h // 2)
    first, second = (
        _plane(raster, h * stride + start, h // 2, w // 2, stride // 2)
        .repeat(2, axis=0)
        .repeat(2, axis=1)
        for start in (0, size)
    )
    return _yuv_to_rgb(y, second if u else first, first if u else second)


def _decode_nv24(raster: Raster) -> np.ndarray:
    """Y plane, then UV pairs at full resolution, in rows of twice the step."""
    h, w = raster.height, raster.width
    stride = _luma_stride(raster, tight=w * h * 3)
    if stride == raster.step:
        _check_buffer(raster, w, full=stride * h * 3, last_padding=2 * (stride - w))
    y = _plane(raster, 0, h, w, stride)
    uv = _plane(raster, h * stride, h, 2 * w, 2 * stride).reshape(h, w, 2)
    return _yuv_to_rgb(y, uv[..., 0], uv[..., 1])


def _decoders() -> dict[str, Callable[[Raster], np.ndarray]]:
    table: dict[str, Callable[[Raster], np.ndarray]] = {}
    for bits, kind in (("8", "u1"), ("16", "u2")):
        packed = {
            f"rgb{bits}": (3, None),
            f"rgba{bits}": (4, cv2.COLOR_RGBA2RGB),
            f"bgr{bits}": (3, cv2.COLOR_BGR2RGB),
            f"bgra{bits}": (4, cv2.COLOR_BGRA2RGB),
            f"mono{bits}": (1, cv2.COLOR_GRAY2RGB),
            f"{bits}UC1": (1, cv2.COLOR_GRAY2RGB),
            f"{bits}UC3": (3, cv2.COLOR_BGR2RGB),
            f"{bits}UC4": (4, cv2.COLOR_BGRA2RGB),
        }
        for name, (channels, code) in packed.items():
            table[name] = partial(_decode_packed, kind=kind, channels=channels, to_rgb=code)
        for pattern in ("rggb", "bggr", "gbrg", "grbg"):
            table[f"bayer_{pattern}{bits}"] = partial(_decode_bayer, kind=kind, pattern=pattern)
    for name in ("uyvy", "yuv422"):
        table[name] = partial(_decode_yuv422, luma=1, chroma=0)
    for name in ("yuyv", "yuv422_yuy2"):
        table[name] = partial(_decode_yuv422, luma=0, chroma=1)
    for name, u in (("nv12", 0), ("nv21", 1)):
        table[name] = partial(_decode_nv, u=u)
    for name, u in (("i420", 0), ("yuv420", 0), ("yv12", 1)):
        table[name] = partial(_decode_planar, u=u)
    table.update({"nv24": _decode_nv24, "32FC1": _decode_float})
    return table


_DECODERS = _decoders()
COLOUR_ENCODINGS = tuple(sorted(_DECODERS))
DEPTH_ENCODINGS = ("16UC1", "32FC1", "mono16")


def decode_colour(raster: Raster) -> np.ndarray:
    """-> H x W x 3 uint8 RGB, a new array.

    16 bit is scaled over the range of the raster's bits; 8UC3 and 8UC4 are BGR(A), as OpenCV
    means them; YUV is BT.601 limited range; 32FC1 is grey in 0..1.

    Raises MessageError: an encoding not in COLOUR_ENCODINGS, a step shorter than a row, data that
    does not have the bytes that step and height say, a size of zero, odd YUV sizes.
    """
    decoder = _DECODERS.get(raster.encoding)
    if decoder is None:
        raise MessageError(
            f"encoding {quoted(raster.encoding)} is not known; known: bgr8, rgb8, mono8, "
            "bayer_rggb8, yuv422, yuyv, nv12 and their like, see docs/node.md"
        )
    _check_size(raster)
    return decoder(raster)


def metres_per_value(encoding: str, scale: float | None = None) -> float:
    """Of stored depth; scale: stored values per metre, None: millimetres but for 32FC1."""
    return 1 / scale if scale else 1.0 if encoding == "32FC1" else 0.001


def decode_metric_depth(
    raster: Raster, *, zero: bool = False, full: bool = False, scale: float | None = None
) -> np.ndarray:
    """-> H x W float32 metres, NaN where there is no depth (REP-118).

    16UC1 and mono16 are millimetres, 0 and FULL invalid; 32FC1 is metres, where zero, negative and
    non-finite values are invalid. zero: a 0 of 32FC1 is valid, as it is of disparity (far away).
    full: FULL is valid, as it is of inverse depth (near). scale: stored values per metre, instead
    of 1000 and 1.
    Raises MessageError as decode_colour does.
    """
    if raster.encoding not in DEPTH_ENCODINGS:
        raise MessageError(
            f"encoding {quoted(raster.encoding)} is no depth; known: {', '.join(DEPTH_ENCODINGS)}"
        )
    _check_size(raster)
    if raster.encoding == "32FC1":
        depth: np.ndarray = _rows(raster, "f4", 1)[..., 0].copy()
        valid = depth >= 0 if zero else depth > 0
    else:
        depth = _rows(raster, "u2", 1)[..., 0].astype(np.float32)
        valid = (depth > 0) & (full | (depth < FULL))
    depth *= np.float32(metres_per_value(raster.encoding, scale))
    depth[~(np.isfinite(depth) & valid)] = np.nan
    return depth
