"""Messages to arrays and back, without a graph."""

from __future__ import annotations

import array
import os
import re
import struct
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from dyfn_core.geometry.camera import valid_depth
from dyfn_ros.messages import images as messages
from dyfn_ros.messages.camera_info import camera_info_message, decode_camera_info
from dyfn_ros.messages.clouds import (
    CLOUD_DTYPE,
    COMPACT_DTYPE,
    CloudMemory,
    cloud_message,
    cloud_points,
    pack_cloud,
)
from dyfn_ros.messages.compressed_image import Layout, decode_compressed, parse_format
from dyfn_ros.messages.images import MessageError
from dyfn_ros.messages.jpeg_complaints import with_complaints

K = [100.0, 0.0, 63.5, 0.0, 110.0, 47.5, 0.0, 0.0, 1.0]


def header() -> Header:
    result = Header(frame_id="camera_optical")
    result.stamp.sec, result.stamp.nanosec = 12, 34
    return result


def info(**fields: Any) -> CameraInfo:
    return CameraInfo(**{"height": 96, "width": 128, "k": K, **fields})


def compressed(data: bytes, name: str) -> CompressedImage:
    message = CompressedImage(format=name)
    message.data = array.array("B", data)
    return message


def picture(height: int = 24, width: int = 40) -> np.ndarray:
    """A smooth picture with red at the left top, which JPEG keeps to a few levels."""
    v, u = np.mgrid[:height, :width].astype(float)
    rgb = np.stack([255 - 200 * u / width, 200 * v / height, np.full_like(u, 60)], axis=2)
    return rgb.astype(np.uint8)


def encoded(suffix: str, image: np.ndarray) -> bytes:
    ok, data = cv2.imencode(suffix, image)
    assert ok
    return data.tobytes()


def test_the_same_image_from_every_kind_of_message() -> None:
    pixels = np.arange(24, dtype=np.uint8)
    fields = {"height": 2, "width": 4, "encoding": "bgr8", "is_bigendian": 0, "step": 12}
    ros = Image(**fields, data=array.array("B", pixels.tobytes()))
    bag_types = get_typestore(Stores.ROS2_JAZZY).types
    stamp = bag_types["builtin_interfaces/msg/Time"](0, 0)
    bag = bag_types["sensor_msgs/msg/Image"](
        header=bag_types["std_msgs/msg/Header"](stamp, ""), **fields, data=pixels
    )
    plain = SimpleNamespace(**fields, data=pixels.tobytes())
    expected = pixels.reshape(2, 4, 3)[..., ::-1]
    for message in (ros, bag, plain):
        assert np.array_equal(messages.decode_image(message), expected)


def test_empty_data_is_refused_by_length() -> None:
    with pytest.raises(MessageError, match="data has 0 bytes"):
        messages.decode_image(Image(height=2, width=2, encoding="rgb8", step=6))


def test_module_needs_no_ros() -> None:
    code = (
        "import sys; sys.modules.update(dict.fromkeys(['rclpy', 'sensor_msgs', 'std_msgs']));"
        "import dyfn_ros.messages.images, dyfn_ros.messages.clouds; print('fine')"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout == "fine\n", result.stderr


@pytest.mark.parametrize("name", ["png", "bgr8; png compressed bgr8", "jpeg", "", "rgb8;PNG "])
def test_png_gives_its_pixels_whatever_format_says(name: str) -> None:
    rgb = picture()
    data = encoded(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    assert np.array_equal(decode_compressed(compressed(data, name)), rgb)


@pytest.mark.parametrize("name", ["jpeg", "rgb8; jpeg compressed bgr8", "jpg"])
def test_jpeg_gives_its_colours_in_rgb_order(name: str) -> None:
    rgb = picture()
    data = encoded(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    got = decode_compressed(compressed(data, name)).astype(int)
    assert np.abs(got - rgb).max() <= 8


@pytest.mark.parametrize(
    ("suffix", "dtype"), [(".png", np.uint8), (".jpg", np.uint8), (".png", np.uint16)]
)
def test_grey_files_become_rgb(suffix: str, dtype: type) -> None:
    level = 120 if dtype is np.uint8 else 120 * 257
    data = encoded(suffix, np.full((8, 6), level, dtype))
    got = decode_compressed(compressed(data, "mono8; x compressed"))
    assert got.shape == (8, 6, 3)
    assert np.abs(got.astype(int) - 120).max() <= 1


@pytest.mark.parametrize(
    ("text", "layout"),
    [
        ("jpeg", Layout(codec="jpeg")),
        ("rgb8; jpeg compressed bgr8", Layout("rgb8", "jpeg", "bgr8")),
        ("bayer_rggb8; png compressed ", Layout("bayer_rggb8", "png", "")),
        (" mono8 ;jpg", Layout("mono8", "jpg", "")),
        ("", Layout()),
        (";;", Layout()),
    ],
)
def test_the_format_says_what_was_compressed(text: str, layout: Layout) -> None:
    assert parse_format(text) == layout


def test_a_codec_that_was_given_rgb_gives_rgb_back() -> None:
    rgb = picture()
    data = encoded(".png", rgb)  # OpenCV takes it for BGR, as the publisher's codec did
    assert np.array_equal(decode_compressed(compressed(data, "rgb8; png compressed rgb8")), rgb)


@pytest.mark.parametrize(("bits", "factor"), [(8, 1), (16, 257)])
def test_a_compressed_bayer_mosaic_is_demosaiced(bits: int, factor: int) -> None:
    mosaic = np.empty((6, 8), np.uint8 if bits == 8 else np.uint16)
    for i, value in enumerate((200, 100, 100, 50)):  # rggb
        mosaic[i // 2 :: 2, i % 2 :: 2] = value * factor
    message = compressed(encoded(".png", mosaic), f"bayer_rggb{bits}; png compressed ")
    assert (decode_compressed(message) == (200, 100, 50)).all()
    demosaiced = compressed(encoded(".png", picture()), "bayer_rggb8; png compressed bgr8")
    assert np.array_equal(decode_compressed(demosaiced), picture()[..., ::-1])


@pytest.mark.parametrize("name", ["bayer_rggb16; png compressed ", "bayer_xyz8; png compressed"])
def test_a_file_that_is_no_such_mosaic_is_refused(name: str) -> None:
    with pytest.raises(MessageError, match="needs a grey picture"):
        decode_compressed(compressed(encoded(".png", np.zeros((6, 8), np.uint8)), name))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_cut_off_files_are_refused(suffix: str, share: float) -> None:
    data = encoded(suffix, np.random.default_rng(0).integers(0, 256, (40, 40, 3), np.uint8))
    with pytest.raises(MessageError, match="ends early"):
        decode_compressed(compressed(data[: int(share * len(data))], "jpeg"))


def jpeg() -> bytes:
    noise = np.random.default_rng(0).integers(0, 256, (60, 80, 3), np.uint8)
    return bytes(encoded(".jpg", cv2.resize(noise, (320, 240))))


def test_a_damaged_jpeg_is_refused_and_nothing_goes_to_standard_error(
    capfd: pytest.CaptureFixture[str],
) -> None:
    whole = jpeg()
    flipped = bytearray(whole)
    for place in np.random.default_rng(0).integers(1000, len(whole) - 100, 20):
        flipped[place] ^= 0x55
    for data in (whole[: len(whole) // 2] + b"\xff\xd9", bytes(flipped)):
        with pytest.raises(MessageError, match="the JPEG is damaged: Corrupt JPEG data"):
            decode_compressed(compressed(data, "jpeg"))
    assert capfd.readouterr().err == ""


def test_a_jpeg_that_is_whole_but_for_its_end_is_used_and_told() -> None:
    whole, told = jpeg(), []
    data = whole[:-2] + bytes(6) + whole[-2:]
    found = decode_compressed(compressed(data, "jpeg"), damaged=told.append)
    assert np.array_equal(found, decode_compressed(compressed(whole, "jpeg")))
    (text,) = told
    assert re.fullmatch("the JPEG is damaged, but whole: .* [1-8] extraneous bytes .*", text)


def test_what_others_write_to_standard_error_meanwhile_is_passed_on(
    capfd: pytest.CaptureFixture[str],
) -> None:
    def decode() -> int:
        os.write(2, b"from elsewhere\nCorrupt JPEG data: bad Huffman code\n")
        return 7

    assert with_complaints(decode) == (7, ["Corrupt JPEG data: bad Huffman code"])
    assert capfd.readouterr().err == "from elsewhere\n"


@pytest.mark.parametrize("bits", [10, 12, 14])
@pytest.mark.parametrize("name", ["mono16", "bayer_rggb16"])
def test_sixteen_bit_files_may_have_fewer_bits(name: str, bits: int) -> None:
    level = round(120 / 255 * ((1 << bits) - 1))
    data = encoded(".png", np.full((8, 6), level, np.uint16))
    for layout in (f"{name}; png compressed ", name):
        got = decode_compressed(compressed(data, layout), bits=bits)
        assert np.abs(got.astype(int) - 120).max() <= 1


@pytest.mark.parametrize(
    ("data", "name", "match"),
    [
        (b"", "jpeg", "0 bytes"),
        (b"\0\0\0\1\x67" * 20, "h264", "neither JPEG nor PNG"),
        (b"GIF89a" + bytes(50), "gif", "neither JPEG nor PNG"),
        (b"\xff\xd8\xff" + bytes(20) + b"\xff\xda\xff\xd9", "jpeg", "cannot be decoded"),
        (b"\x89PNG\r\n\x1a\n" + bytes(20) + b"IEND", "png", "cannot be decoded"),
        (b"\x89PNG\r\n\x1a\n", "16UC1; compressedDepth png", "depth image"),
    ],
)
def test_what_is_no_picture_is_refused(data: bytes, name: str, match: str) -> None:
    with pytest.raises(MessageError, match=match):
        decode_compressed(compressed(data, name))


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200), st.sampled_from([b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"]))
def test_any_bytes_are_a_picture_or_refused(tail: bytes, start: bytes) -> None:
    try:
        image = decode_compressed(compressed(start + tail, "jpeg"))
    except MessageError:
        return
    assert image.ndim == 3


def test_calibration_is_k_and_knows_about_the_lens() -> None:
    plain = decode_camera_info(info(), 96, 128)
    assert plain.matrix.tolist() == np.reshape(K, (3, 3)).tolist()
    assert not plain.distorted
    assert decode_camera_info(info(d=[0.1, 0, 0, 0, 0]), 96, 128).distorted
    assert not decode_camera_info(info(d=[0.0] * 5), 96, 128).distorted


def test_rectified_images_take_p() -> None:
    p = [90.0, 0, 60, -4, 0, 91, 40, 0, 0, 0, 1, 0]
    got = decode_camera_info(info(p=p, d=[0.1] * 5), 96, 128, rectified=True)
    assert got.matrix.tolist() == [[90, 0, 60], [0, 91, 40], [0, 0, 1]]
    assert not got.distorted


def test_ros1_field_names_are_read_too() -> None:
    roi = SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0)
    old = SimpleNamespace(
        K=K,
        P=[0] * 12,
        D=[],
        distortion_model="",
        height=96,
        width=128,
        roi=roi,
        binning_x=0,
        binning_y=0,
    )
    assert decode_camera_info(old, 96, 128).matrix[0, 0] == 100


@settings(max_examples=60, deadline=None)
@given(
    x=st.integers(0, 40),
    y=st.integers(0, 40),
    bin_x=st.sampled_from([0, 1, 2, 4]),
    bin_y=st.sampled_from([0, 1, 2, 4]),
)
def test_binning_and_region_move_rays_with_their_pixels(
    x: int, y: int, bin_x: int, bin_y: int
) -> None:
    """The ray through a binned pixel's centre is the one through the middle of its block."""
    message = info(binning_x=bin_x, binning_y=bin_y)
    message.roi.x_offset, message.roi.y_offset = x, y
    message.roi.width, message.roi.height = 64, 48
    bx, by = max(bin_x, 1), max(bin_y, 1)
    m = decode_camera_info(message, 48 // by, 64 // bx).matrix
    u, v = 5, 3
    full_u, full_v = x + u * bx + (bx - 1) / 2, y + v * by + (by - 1) / 2
    assert (u - m[0, 2]) / m[0, 0] == pytest.approx((full_u - K[2]) / K[0])
    assert (v - m[1, 2]) / m[1, 1] == pytest.approx((full_v - K[5]) / K[4])


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"k": [0.0] * 9}, r"uncalibrated: K\[0\] is 0"),
        ({"width": 64}, "is for 64 x 96 pixels, but the images have 128 x 96"),
        ({"width": 0, "height": 0}, "is for 0 x 0"),
        ({"binning_x": 2}, "is for 64 x 96"),
        ({"k": [np.nan, *K[1:]]}, "no pinhole"),
        ({"k": [-1.0, *K[1:]]}, "no pinhole"),
        ({"k": [*K[:4], 0.0, *K[5:]]}, "no pinhole"),
        ({"k": [*K[:8], 0.0]}, "no pinhole"),
        ({"k": [K[0], 0.5, *K[2:]]}, "no pinhole"),
    ],
)
def test_unusable_calibrations_say_why(fields: dict[str, Any], match: str) -> None:
    with pytest.raises(MessageError, match=match):
        decode_camera_info(info(**fields), 96, 128)


def test_depth_message_is_float_metres_with_nan_and_never_zero() -> None:
    depth = np.array([[1.5, 0.0, np.inf], [-2.0, np.nan, 3.0]], np.float32)
    mask = np.array([[1, 1, 1], [1, 1, 0]], bool)
    message = messages.depth_message(header(), depth, valid_depth(depth, mask))
    assert (message.height, message.width, message.step) == (2, 3, 12)
    assert (message.encoding, message.is_bigendian) == ("32FC1", 0)
    assert message.header == header()
    nan = struct.pack("<f", float("nan"))
    assert bytes(message.data) == struct.pack("<f", 1.5) + nan * 5
    assert np.array_equal(
        messages.decode_depth(message), [[1.5] + [np.nan] * 2, [np.nan] * 3], True
    )


def test_cloud_has_the_layout_of_pcl() -> None:
    points = np.arange(18, dtype=np.float32).reshape(2, 3, 3)
    valid = np.array([[1, 1, 1], [1, 0, 1]], bool)
    image = np.arange(100, 118, dtype=np.uint8).reshape(2, 3, 3)
    message = cloud_message(header(), pack_cloud(points, valid, image))
    assert (message.height, message.width) == (2, 3)
    assert (message.point_step, message.row_step) == (32, 96)
    assert (message.is_dense, message.is_bigendian) == (False, False)
    assert [(f.name, f.offset, f.datatype, f.count) for f in message.fields] == [
        ("x", 0, 7, 1),
        ("y", 4, 7, 1),
        ("z", 8, 7, 1),
        ("rgb", 16, 7, 1),
    ]
    data = bytes(message.data)
    row1_column2 = data[32 * 5 :]
    assert struct.unpack("<3f", row1_column2[:12]) == (15, 16, 17)
    assert row1_column2[12:16] == bytes(4)
    assert row1_column2[16:20] == bytes([117, 116, 115, 0])  # little endian 0x00RRGGBB
    assert all(np.isnan(struct.unpack("<3f", data[128:140])))


def test_cloud_survives_the_round_trip_bit_for_bit() -> None:
    rng = np.random.default_rng(1)
    cloud = pack_cloud(
        rng.normal(size=(5, 7, 3)).astype(np.float32),
        rng.random((5, 7)) < 0.7,
        rng.integers(0, 256, (5, 7, 3)).astype(np.uint8),
    )
    back = cloud_points(cloud_message(header(), cloud))
    assert back.tobytes() == cloud.tobytes()


def test_a_compact_cloud_has_the_same_values_in_half_the_bytes() -> None:
    rng = np.random.default_rng(1)
    arrays = (
        rng.normal(size=(5, 7, 3)).astype(np.float32),
        rng.random((5, 7)) < 0.7,
        rng.integers(0, 256, (5, 7, 3)).astype(np.uint8),
    )
    message = cloud_message(header(), pack_cloud(*arrays, COMPACT_DTYPE))
    assert (message.point_step, message.row_step, len(message.data)) == (16, 112, 560)
    assert [(f.name, f.offset) for f in message.fields][3] == ("rgb", 12)
    compact, padded = cloud_points(message), pack_cloud(*arrays)
    for name in CLOUD_DTYPE.names:
        assert compact[name].tobytes() == padded[name].tobytes(), name


@pytest.mark.parametrize("shape", [(5, 7), (3, 4), (0, 0)])
def test_memory_that_held_another_cloud_leaves_nothing_of_it(shape: tuple[int, int]) -> None:
    memory = CloudMemory()
    for seed, dtype in enumerate((COMPACT_DTYPE, CLOUD_DTYPE, CLOUD_DTYPE)):
        rng = np.random.default_rng(seed)
        points = rng.normal(size=(*shape, 3)).astype(np.float32)
        valid = rng.random(shape) < 0.5
        image = rng.integers(0, 256, (*shape, 3)).astype(np.uint8)
        cloud = pack_cloud(points, valid, image, dtype, memory)
        assert cloud.tobytes() == pack_cloud(points, valid, image, dtype).tobytes()
        message = cloud_message(header(), cloud, memory)
        assert bytes(message.data) == cloud.tobytes()
        assert message == cloud_message(header(), cloud)
        assert message.data is memory.data


def test_clouds_of_another_layout_are_refused() -> None:
    cloud = np.zeros((2, 2), CLOUD_DTYPE)
    other = cloud_message(header(), cloud)
    other.fields[3].offset = 12
    with pytest.raises(MessageError, match="layout"):
        cloud_points(other)
    short = cloud_message(header(), cloud)
    short.data = array.array("B", bytes(100))
    with pytest.raises(MessageError, match="100 bytes"):
        cloud_points(short)


def test_estimated_camera_info_says_the_same_in_k_and_p() -> None:
    matrix = np.array([[50.0, 0, 3], [0, 51, 4], [0, 0, 1]])
    message = camera_info_message(header(), matrix, 8, 10)
    assert message.header == header()
    for rectified in (False, True):
        got = decode_camera_info(message, 8, 10, rectified=rectified)
        assert np.array_equal(got.matrix, matrix)
        assert not got.distorted
