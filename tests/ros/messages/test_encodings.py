"""Raw encodings: every one by value against hand-made pixels, then by properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyfn_ros.messages.encodings import (
    COLOUR_ENCODINGS,
    MessageError,
    Raster,
    decode_colour,
    decode_metric_depth,
)

RED, GREEN, BLUE, GREY = (255, 0, 0), (0, 255, 0), (0, 0, 255), (128, 128, 128)
# 2 x 2 pixels: red, green / blue, grey.
PIXELS = np.array([[RED, GREEN], [BLUE, GREY]], np.uint8)
# BT.601 limited range (Y, U, V) of pure colours, from the standard's tables.
YUV = {
    "red": (81, 90, 240),
    "green": (145, 54, 34),
    "blue": (41, 240, 110),
    "grey": (126, 128, 128),
}
RGB = {"red": RED, "green": GREEN, "blue": BLUE, "grey": GREY}

PACKED = {
    "rgb8": "ff0000 00ff00 0000ff 808080",
    "bgr8": "0000ff 00ff00 ff0000 808080",
    "8UC3": "0000ff 00ff00 ff0000 808080",
    "rgba8": "ff000007 00ff0007 0000ff07 80808007",
    "bgra8": "0000ff07 00ff0007 ff000007 80808007",
    "8UC4": "0000ff07 00ff0007 ff000007 80808007",
    "rgb16": "ffff00000000 0000ffff0000 00000000ffff 808080808080",
    "bgr16": "00000000ffff 0000ffff0000 ffff00000000 808080808080",
    "16UC3": "00000000ffff 0000ffff0000 ffff00000000 808080808080",
    "rgba16": "ffff000000000101 0000ffff00000101 00000000ffff0101 8080808080800101",
    "bgra16": "00000000ffff0101 0000ffff00000101 ffff000000000101 8080808080800101",
    "16UC4": "00000000ffff0101 0000ffff00000101 ffff000000000101 8080808080800101",
}


def raster(
    data: bytes | np.ndarray, height: int, width: int, encoding: str, step: int, big: bool = False
) -> Raster:
    return Raster(np.frombuffer(bytes(data), np.uint8), height, width, encoding, step, big)


@pytest.mark.parametrize("encoding", PACKED)
@pytest.mark.parametrize("big", [False, True])
def test_packed_colours_have_their_channels_in_order(encoding: str, big: bool) -> None:
    data = bytes.fromhex(PACKED[encoding])  # 16 bit samples are the same either way round
    step = len(data) // 2
    assert np.array_equal(decode_colour(raster(data, 2, 2, encoding, step, big)), PIXELS)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_goes_to_all_channels(encoding: str) -> None:
    rgb = decode_colour(raster(bytes([0, 1, 200, 255]), 2, 2, encoding, 2))
    assert rgb.tolist() == [[[0] * 3, [1] * 3], [[200] * 3, [255] * 3]]


@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
@pytest.mark.parametrize("big", [False, True])
def test_sixteen_bits_use_their_full_range_and_byte_order(encoding: str, big: bool) -> None:
    values = np.array([0, 128, 129, 257, 25700, 65535], ">u2" if big else "<u2")
    rgb = decode_colour(raster(values.tobytes(), 1, 6, encoding, 12, big))
    assert rgb[0, :, 0].tolist() == [0, 0, 1, 1, 100, 255]
    assert (rgb == rgb[..., :1]).all()


@pytest.mark.parametrize("big", [False, True])
def test_float_grey_is_zero_to_one_with_nan_black(big: bool) -> None:
    values = np.array([0, 0.5, 1, np.nan], ">f4" if big else "<f4")
    rgb = decode_colour(raster(values.tobytes(), 1, 4, "32FC1", 16, big))
    assert rgb[0, :, 1].tolist() == [0, 128, 255, 0]


@pytest.mark.parametrize("value", [1.5, -0.1, 255.0, np.inf, -np.inf])
def test_float_grey_outside_its_range_is_refused(value: float) -> None:
    with pytest.raises(MessageError, match=r"0\.\.1"):
        decode_colour(raster(np.array([0.5, value], "<f4").tobytes(), 1, 2, "32FC1", 8))


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize(("bits", "factor"), [("8", 1), ("16", 257)])
@pytest.mark.parametrize(("height", "width"), [(2, 2), (2, 3), (3, 2), (5, 7), (6, 4)])
def test_bayer_of_an_even_colour_is_that_colour_everywhere(
    pattern: str, bits: str, factor: int, height: int, width: int
) -> None:
    colour = {"r": 200, "g": 100, "b": 50}
    mosaic = np.empty((height, width), "u1" if bits == "8" else "<u2")
    for i, letter in enumerate(pattern):
        mosaic[i // 2 :: 2, i % 2 :: 2] = colour[letter] * factor
    step = width * mosaic.itemsize
    rgb = decode_colour(raster(mosaic.tobytes(), height, width, f"bayer_{pattern}{bits}", step))
    assert (rgb == (200, 100, 50)).all()


def test_bayer_keeps_samples_and_averages_neighbours() -> None:
    mosaic = np.array(
        [[10, 20, 30, 40], [50, 60, 70, 80], [90, 100, 110, 120], [130, 140, 150, 160]]
    )
    rgb = decode_colour(raster(mosaic.astype(np.uint8).tobytes(), 4, 4, "bayer_rggb8", 4))
    assert rgb[2, 2].tolist() == [110, (100 + 120 + 70 + 150) // 4, (60 + 80 + 140 + 160) // 4]
    assert rgb[1, 1].tolist() == [(10 + 30 + 90 + 110) // 4, (20 + 50 + 70 + 100) // 4, 60]
    assert rgb[1, 2].tolist() == [(30 + 110) // 2, 70, (60 + 80) // 2]
    assert rgb[0, 0, 0] == 10


def test_bayer_of_one_row_is_refused() -> None:
    with pytest.raises(MessageError, match="2 x 2"):
        decode_colour(raster(bytes(4), 1, 4, "bayer_rggb8", 4))


@pytest.mark.parametrize("encoding", ["uyvy", "yuv422", "yuyv", "yuv422_yuy2"])
@pytest.mark.parametrize("colour", YUV)
def test_yuv422_colours_in_both_byte_orders(encoding: str, colour: str) -> None:
    y, u, v = YUV[colour]
    pair = [u, y, v, y] if encoding in ("uyvy", "yuv422") else [y, u, y, v]
    dark = [128, 16, 128, 235] if encoding in ("uyvy", "yuv422") else [16, 128, 235, 128]
    rgb = decode_colour(raster(bytes(pair + dark), 1, 4, encoding, 8)).astype(int)
    assert np.abs(rgb[0, :2] - RGB[colour]).max() <= 2
    assert rgb[0, 2].tolist() == [0, 0, 0]
    assert rgb[0, 3].tolist() == [255, 255, 255]


def planar(encoding: str, colours: list[list[str]]) -> tuple[np.ndarray, np.ndarray]:
    """Y and interleaved chroma planes; all but nv24 have one pair per 2 x 2 pixels."""
    yuv = np.array([[YUV[name] for name in row] for row in colours], np.uint8)
    if encoding == "nv24":
        return yuv[..., 0], yuv[..., 1:].reshape(len(yuv), -1)
    order = slice(None, 0, -1) if encoding in ("nv21", "yv12") else slice(1, None)
    return yuv[..., 0], yuv[::2, ::2, order].reshape(len(yuv) // 2, -1)


@pytest.mark.parametrize("padding", [0, 1, 5])
@pytest.mark.parametrize("encoding", ["nv21", "nv12"])
def test_chroma_pairs_are_shared_between_four_pixels(padding: int, encoding: str) -> None:
    colours = [["red"] * 2 + ["blue"] * 2] * 2 + [["green"] * 2 + ["grey"] * 2] * 2
    y, chroma = planar(encoding, colours)
    data = np.pad(np.vstack([y, chroma]), ((0, 0), (0, padding)), constant_values=77)
    rgb = decode_colour(raster(data.tobytes(), 4, 4, encoding, 4 + padding)).astype(int)
    expected = np.array([[RGB[name] for name in row] for row in colours])
    assert np.abs(rgb - expected).max() <= 2


@pytest.mark.parametrize("padding", [0, 2, 6])
@pytest.mark.parametrize("cut", [False, True])
@pytest.mark.parametrize("encoding", ["i420", "yuv420", "yv12"])
def test_chroma_planes_are_shared_between_four_pixels(
    padding: int, cut: bool, encoding: str
) -> None:
    """cut: without the padding of the last row."""
    colours = [["red"] * 2 + ["blue"] * 2] * 2 + [["green"] * 2 + ["grey"] * 2] * 2
    y, chroma = planar(encoding, colours)
    pairs = chroma.reshape(2, 2, 2)
    planes = [np.pad(y, ((0, 0), (0, padding)), constant_values=77)]
    for kind in range(2):
        plane = np.pad(pairs[..., kind], ((0, 0), (0, padding // 2)), constant_values=77)
        planes.append(plane)
    data = b"".join(plane.tobytes() for plane in planes)
    data = data[: len(data) - padding // 2] if cut else data
    rgb = decode_colour(raster(data, 4, 4, encoding, 4 + padding)).astype(int)
    expected = np.array([[RGB[name] for name in row] for row in colours])
    assert np.abs(rgb - expected).max() <= 2
    if padding:
        with pytest.raises(MessageError, match="make"):
            decode_colour(raster(data[:-1] if cut else data[:-2], 4, 4, encoding, 4 + padding))


def test_an_odd_step_of_chroma_planes_is_refused() -> None:
    with pytest.raises(MessageError, match="even step, not 5"):
        decode_colour(raster(bytes(15), 2, 4, "i420", 5))


@pytest.mark.parametrize("padding", [0, 1, 5])
def test_nv24_has_chroma_of_its_own_for_each_pixel(padding: int) -> None:
    colours = [["red", "green", "blue"], ["grey", "red", "green"]]
    y, chroma = planar("nv24", colours)
    y = np.pad(y, ((0, 0), (0, padding)), constant_values=77)
    chroma = np.pad(chroma, ((0, 0), (0, 2 * padding)), constant_values=77)
    data = y.tobytes() + chroma.tobytes()
    rgb = decode_colour(raster(data, 2, 3, "nv24", 3 + padding)).astype(int)
    expected = np.array([[RGB[name] for name in row] for row in colours])
    assert np.abs(rgb - expected).max() <= 2


@pytest.mark.parametrize(("encoding", "step"), [("nv21", 6), ("nv12", 6), ("nv24", 12)])
def test_planar_step_may_count_all_planes(encoding: str, step: int) -> None:
    colours = [["red", "red", "blue", "blue"]] * 2
    y, chroma = planar(encoding, colours)
    data = y.tobytes() + chroma.tobytes()
    one = decode_colour(raster(data, 2, 4, encoding, 4))
    assert np.array_equal(decode_colour(raster(data, 2, 4, encoding, step)), one)


@pytest.mark.parametrize("encoding", ["uyvy", "yuyv", "nv21", "nv12", "i420"])
def test_odd_width_of_shared_chroma_is_refused(encoding: str) -> None:
    with pytest.raises(MessageError, match="even width"):
        decode_colour(raster(bytes(100), 2, 3, encoding, 6))


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_sixteen_bit_encodings_may_have_fewer_bits(bits: int) -> None:
    most = (1 << bits) - 1
    values = np.array([0, 1, most // 2, most - 1, most, 65535], "<u2")
    found = decode_colour(Raster(values.view(np.uint8), 1, 6, "mono16", 12, bits=bits))
    exact = np.minimum(values, most) * (255 / most)
    assert np.abs(found[0, :, 0] - exact).max() <= 0.5
    assert found[0, -2:, 0].tolist() == [255, 255]


def test_a_name_of_any_length_is_said_shortly() -> None:
    with pytest.raises(MessageError) as error:
        decode_colour(raster(bytes(12), 2, 2, "j" * 100_000, 6))
    assert len(str(error.value)) < 200


def test_unknown_encoding_is_refused_with_the_known_ones() -> None:
    with pytest.raises(MessageError, match=r"'jello' is not known; known: .*bgr8.*yuyv"):
        decode_colour(raster(bytes(12), 2, 2, "jello", 6))


@pytest.mark.parametrize(("height", "width"), [(0, 4), (4, 0), (0, 0)])
@pytest.mark.parametrize("encoding", COLOUR_ENCODINGS)
def test_zero_size_is_refused(encoding: str, height: int, width: int) -> None:
    with pytest.raises(MessageError, match="at least 1"):
        decode_colour(raster(b"", height, width, encoding, 16))


def test_step_shorter_than_a_row_is_refused() -> None:
    with pytest.raises(MessageError, match="step is 5 bytes, but a row of 2 pixels of rgb8 has 6"):
        decode_colour(raster(bytes(12), 2, 2, "rgb8", 5))


@pytest.mark.parametrize("size", [0, 11, 13, 100])
def test_data_of_another_length_is_refused(size: int) -> None:
    with pytest.raises(MessageError, match=rf"data has {size} bytes, .* make 12"):
        decode_colour(raster(bytes(size), 2, 2, "rgb8", 6))


PLANAR = ("i420", "yuv420", "yv12")
SHARED_420 = ("nv12", "nv21", *PLANAR)


def tight_size(encoding: str, height: int, width: int) -> tuple[int, int]:
    """Bytes of a row that step describes, and rows (in such rows) of the whole buffer times 2."""
    if encoding in SHARED_420:
        return width, 3 * height
    if encoding == "nv24":
        return width, 6 * height
    samples = 2 if encoding.startswith(("yu", "uy")) else 1
    samples = 3 if encoding.startswith(("rgb", "bgr")) or encoding.endswith("C3") else samples
    samples = 4 if encoding.startswith(("rgba", "bgra")) or encoding.endswith("C4") else samples
    bytes_each = 4 if encoding == "32FC1" else 2 if "16" in encoding else 1
    return width * samples * bytes_each, 2 * height


@settings(max_examples=300, deadline=None)
@given(
    encoding=st.sampled_from(COLOUR_ENCODINGS),
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    padding=st.integers(0, 11),
    seed=st.integers(0, 2**32 - 1),
    big=st.booleans(),
)
def test_padding_never_changes_or_shears_the_picture(
    encoding: str, height: int, width: int, padding: int, seed: int, big: bool
) -> None:
    row, rows = tight_size(encoding, height, width)
    shared = (*SHARED_420, "uyvy", "yuyv", "yuv422", "yuv422_yuy2")
    if encoding in shared and (width % 2 or height % 2):
        width, height = 2 * width, 2 * height
        row, rows = tight_size(encoding, height, width)
    padding *= 2 if encoding in PLANAR else 1
    if encoding.startswith("bayer"):
        width, height = width + 1, height + 1
        row, rows = tight_size(encoding, height, width)
    rng = np.random.default_rng(seed)
    plain = rng.integers(0, 256, rows * row // 2).astype(np.uint8)
    if encoding == "32FC1":
        values = rng.random(height * width).astype(">f4" if big else "<f4")
        plain = np.frombuffer(values.tobytes(), np.uint8)
    expected = decode_colour(raster(plain, height, width, encoding, row, big))
    padded = pad_rows(encoding, plain, height, row, padding, rng)
    got = decode_colour(raster(padded, height, width, encoding, row + padding, big))
    assert got.shape == (height, width, 3)
    assert got.dtype == np.uint8
    assert np.array_equal(got, expected)


def pad_rows(
    encoding: str, plain: np.ndarray, height: int, row: int, padding: int, rng: np.random.Generator
) -> np.ndarray:
    """Random bytes after each row; twice as many after the double rows of nv24's chroma, half as
    many after the half rows of planes."""

    def padded(plane: np.ndarray, length: int, extra: int) -> np.ndarray:
        plane = plane.reshape(-1, length)
        junk = rng.integers(0, 256, (len(plane), extra)).astype(np.uint8)
        return np.hstack([plane, junk]).reshape(-1)

    luma, chroma = plain[: height * row], plain[height * row :]
    if encoding in PLANAR:
        halves = padded(chroma, row // 2, padding // 2)
        return np.concatenate([padded(luma, row, padding), halves])
    if encoding != "nv24":
        return padded(plain, row, padding)
    return np.concatenate([padded(luma, row, padding), padded(chroma, 2 * row, 2 * padding)])


@settings(max_examples=300, deadline=None)
@given(
    encoding=st.sampled_from([*COLOUR_ENCODINGS, "", "RGB8", "rgb8 ", "compressed"]),
    height=st.integers(0, 6),
    width=st.integers(0, 6),
    step=st.integers(0, 60),
    size=st.integers(0, 400),
)
def test_any_header_is_decoded_or_refused(
    encoding: str, height: int, width: int, step: int, size: int
) -> None:
    try:
        rgb = decode_colour(raster(bytes(size), height, width, encoding, step))
    except MessageError:
        return
    row, rows = tight_size(encoding, height, width)
    assert rgb.shape == (height, width, 3)
    assert step >= row
    assert size >= row * rows // 2


@pytest.mark.parametrize("big", [False, True])
def test_depth_in_millimetres_becomes_metres_and_both_ends_nan(big: bool) -> None:
    values = np.array([0, 1, 65534, 65535], ">u2" if big else "<u2")
    stored = raster(values.tobytes(), 2, 2, "16UC1", 4, big)
    depth = decode_metric_depth(stored)
    assert depth.dtype == np.float32
    expected = [[np.nan, 0.001], [65.534, np.nan]]
    np.testing.assert_allclose(depth, expected, rtol=1e-6)
    assert decode_metric_depth(stored, full=True)[1, 1] == np.float32(65.535)


def test_float_depth_keeps_metres_and_only_what_is_in_front() -> None:
    values = np.array([[2.5, 0, -1], [np.nan, np.inf, -np.inf]], "<f4")
    padded = np.hstack([values.view(np.uint8).reshape(2, 12), np.full((2, 3), 9, np.uint8)])
    depth = decode_metric_depth(raster(padded.tobytes(), 2, 3, "32FC1", 15))
    assert depth[0, 0] == 2.5
    assert np.isnan(depth.reshape(-1)[1:]).all()


def test_colour_is_no_depth() -> None:
    with pytest.raises(MessageError, match="'rgb8' is no depth; known: 16UC1, 32FC1"):
        decode_metric_depth(raster(bytes(12), 2, 2, "rgb8", 6))
