"""Messages of distance sensors by value: hand-made bytes in, points and distances out."""

from __future__ import annotations

import array
import math
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sensor_msgs.msg import Image, LaserScan, PointCloud2, PointField, Range

from dyfn_core.geometry.rigid import rigid
from dyfn_core.metric.references import ConeReference, DepthReference, PointReference
from dyfn_ros.messages.images import MessageError
from dyfn_ros.messages.reference_options import ReferenceOptions
from dyfn_ros.messages.references import (
    decode_points,
    decode_range,
    decode_reference,
    decode_scan,
    message_references,
    parse_transform,
)
from dyfn_ros.messages.transforms import TransformBuffer
from tests.support.odometry import tf_message, transform

FLOAT32, FLOAT64, UINT16 = 7, 8, 4


def cloud(
    points: list[tuple[float, float, float]],
    *,
    width: int = 0,
    offsets: tuple[int, int, int] = (0, 4, 8),
    kind: int = FLOAT32,
    step: int = 16,
    padding: int = 0,
    big: bool = False,
) -> PointCloud2:
    """A PointCloud2 packed byte by byte."""
    width = width or len(points)
    height = len(points) // width if points else 1
    number = (">" if big else "<") + {FLOAT32: "f", FLOAT64: "d"}.get(kind, "H")
    data = bytearray()
    for row in range(height):
        for point in points[row * width : (row + 1) * width]:
            packed = bytearray(b"\xab" * step)
            for value, offset in zip(point, offsets, strict=True):
                struct.pack_into(number, packed, offset, value)
            data += packed
        data += b"\xcd" * padding
    fields = [PointField(name="intensity", offset=0, datatype=2, count=1)]
    fields += [
        PointField(name=axis, offset=offset, datatype=kind, count=1)
        for axis, offset in zip("xyz", offsets, strict=True)
    ]
    message = PointCloud2(height=height, width=width, fields=fields, point_step=step)
    message.row_step, message.is_bigendian = step * width + padding, big
    message.data = array.array("B", bytes(data))
    return message


POINTS = [(1.0, 2.0, 3.0), (-4.5, 0.25, 8.0), (0.0, -1.0, 2.5), (7.0, 7.5, -7.25)]


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(
    "layout",
    [
        {},
        {"offsets": (12, 0, 8)},
        {"kind": FLOAT64, "offsets": (8, 16, 24), "step": 34},
        {"width": 2, "padding": 5},
        {"step": 12},
    ],
)
def test_cloud_of_any_layout_gives_its_points(layout: dict[str, object], big: bool) -> None:
    message = cloud(POINTS, big=big, **layout)  # type: ignore[arg-type]
    np.testing.assert_array_equal(decode_points(message), POINTS)


def test_empty_cloud_has_no_points() -> None:
    assert decode_points(cloud([])).shape == (0, 3)


def test_clouds_without_usable_coordinates_are_refused() -> None:
    message = cloud(POINTS)
    message.fields = list(message.fields)[:3]
    with pytest.raises(MessageError, match="expected x, y and z"):
        decode_points(message)
    with pytest.raises(MessageError, match="x of the cloud is no FLOAT32"):
        decode_points(cloud([(1, 2, 3)], kind=UINT16))
    short = cloud(POINTS)
    short.data = short.data[:-1]
    with pytest.raises(MessageError, match="has 63 bytes"):
        decode_points(short)
    narrow = cloud(POINTS)
    narrow.point_step = 8
    with pytest.raises(MessageError, match="point_step 8 does not hold"):
        decode_points(narrow)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_cloud_is_decoded_right_or_refused_whatever_its_description_says(
    data: st.DataObject,
) -> None:
    message = cloud(POINTS)
    for name, most in (("width", 9), ("height", 4), ("point_step", 40), ("row_step", 90)):
        if data.draw(st.booleans()):
            setattr(message, name, data.draw(st.integers(0, most)))
    try:
        points = decode_points(message)
    except MessageError:
        return
    assert points.shape == (message.width * message.height, 3)
    if message.point_step == 16 and message.width == 4 and message.height:
        np.testing.assert_array_equal(points[:4], POINTS)


def test_scan_becomes_points_and_readings_out_of_range_are_missing() -> None:
    message = LaserScan(
        angle_min=-math.pi / 2, angle_increment=math.pi / 4, range_min=0.1, range_max=10.0
    )
    message.ranges = [1.0, 2.0, math.inf, 0.05, math.nan, 20.0, 3.0]
    points = decode_scan(message)
    half = math.sqrt(2)
    np.testing.assert_allclose(points[0], [0, -1, 0], atol=1e-6)
    np.testing.assert_allclose(points[1], [half, -half, 0], atol=1e-6)
    assert np.isnan(points[2:6, :2]).all()
    np.testing.assert_allclose(points[6], 3 * np.array([-1, 0, 0]), atol=1e-6)


def test_range_says_distance_cone_and_kind() -> None:
    sound = Range(radiation_type=Range.ULTRASOUND, field_of_view=0.5, min_range=0.2, max_range=4.0)
    sound.range = 1.5
    assert decode_range(sound) == (1.5, 0.25, True)
    light = Range(radiation_type=Range.INFRARED, field_of_view=0.0, max_range=4.0)
    for value in (math.inf, -math.inf, math.nan, 5.0):
        light.range = value
        distance, half_angle, is_sound = decode_range(light)
        assert math.isnan(distance)
        assert (half_angle, is_sound) == (0.0, False)
    light.field_of_view = 4.0
    with pytest.raises(MessageError, match="field_of_view is 4"):
        decode_range(light)


def test_body_frame_sensors_look_along_the_optical_axis_by_default() -> None:
    turned = parse_transform("", "LaserScan")
    np.testing.assert_allclose(turned(np.eye(3)), [[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    np.testing.assert_allclose(parse_transform("", "PointCloud2")(np.eye(3)), np.eye(3))


def test_transform_turns_then_moves() -> None:
    root = math.sqrt(0.5)
    moved = parse_transform(f"1, 2, 3, 0, 0, {root}, {root}", "PointCloud2")
    np.testing.assert_allclose(moved(np.array([[1.0, 0, 0]])), [[1, 3, 3]], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "kind", "reason"),
    [
        ("1 2 3", "PointCloud2", "expected seven numbers"),
        ("1 2 3 0 0 0 x", "PointCloud2", "expected seven numbers"),
        ("0 0 0 0 0 0 2", "Range", "quaternion of length 1, not 2"),
        ("0 0 0 0 0 0 nan", "Range", "expected seven numbers"),
        ("0 0 0.1 0 0 0 1", "Image", "must be registered"),
        ("", "Imu", "reference_type is 'Imu'"),
    ],
)
def test_bad_transforms_say_what_was_expected(text: str, kind: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse_transform(text, kind)


def test_each_type_becomes_its_kind_of_measurement() -> None:
    depth = Image(height=1, width=3, encoding="16UC1", step=6)
    depth.data = array.array("B", struct.pack("<3H", 1500, 0, 250))
    decoded = decode_reference(depth, "Image", parse_transform("", "Image"))
    assert isinstance(decoded, DepthReference)
    np.testing.assert_allclose(decoded.depth, [[1.5, np.nan, 0.25]])

    decoded = decode_reference(
        cloud(POINTS), "PointCloud2", parse_transform("0 0 1 0 0 0 1", "PointCloud2")
    )
    assert isinstance(decoded, PointReference)
    np.testing.assert_allclose(decoded.points[0], [1, 2, 4])

    scan = LaserScan(angle_increment=0.1, range_max=5.0, ranges=[2.0])
    decoded = decode_reference(scan, "LaserScan", parse_transform("", "LaserScan"))
    assert isinstance(decoded, PointReference)
    np.testing.assert_allclose(decoded.points, [[0, 0, 2]], atol=1e-12)

    reading = Range(field_of_view=0.4, max_range=5.0, range=2.0)
    decoded = decode_reference(reading, "Range", parse_transform("0.5 0 0 0 0 0 1", "Range"))
    assert isinstance(decoded, ConeReference)
    np.testing.assert_allclose(decoded.hit, [2.5, 0, 0])
    assert decoded.half_angle == pytest.approx(0.2)


def small_view(frame_id: str) -> SimpleNamespace:
    return SimpleNamespace(
        depth=np.ones((3, 3), np.float32),
        valid=np.ones((3, 3), bool),
        camera_matrix=np.array([[1.0, 0, 1], [0, 1, 1], [0, 0, 1]]),
        frame_id=frame_id,
    )


def test_a_message_is_decoded_when_a_frame_needs_it_and_a_bad_one_is_counted() -> None:
    warnings: list[str] = []
    make = message_references(ReferenceOptions(), warnings.append)
    broken, good = cloud(POINTS), cloud([(0.0, 0.0, 2.0)])
    broken.fields = []
    view = small_view("camera")
    bad = make(broken, 5.0)
    assert not warnings
    assert bad.evidence(view, 5.0).dropped == {"not decodable": 1}
    assert "expected x, y and z" in warnings[0]
    assert make(good, 5.0).evidence(view, 5.0).measured.tolist() == [2.0]
    with pytest.raises(ValueError, match="expected seven numbers"):
        message_references(ReferenceOptions(reference_transform="1 2"), warnings.append)


def lidar_cloud(frame_id: str, points: list[tuple[float, float, float]]) -> PointCloud2:
    message = cloud(points)
    message.header.frame_id = frame_id
    return message


def test_a_sensor_of_another_frame_is_placed_by_tf() -> None:
    """The lidar is 1 m behind the camera and looks as a body does: x is forward."""
    warnings: list[str] = []
    buffer = TransformBuffer()
    make = message_references(ReferenceOptions(), warnings.append, buffer)
    ahead = lidar_cloud("/lidar", [(3.0, 0.0, 0.0)])
    view = small_view("camera")
    assert make(ahead, 5.0).evidence(view, 5.0).dropped == {"sensor's place unknown": 1}
    assert "its frame_id is 'lidar', the images are of 'camera', and tf has no frame" in warnings[0]
    assert "set reference_transform" in warnings[0]
    body = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    behind = rigid(body, np.array([0.0, 0.0, -1.0]))
    buffer.take(tf_message(transform(behind, 0, "camera", "lidar")), True)
    found = make(ahead, 5.0).evidence(view, 5.0)
    assert found.measured == pytest.approx([2.0])
    own = lidar_cloud("camera", [(0.0, 0.0, 2.5)])
    assert make(own, 5.0).evidence(view, 5.0).measured.tolist() == [2.5]
    given = ReferenceOptions(reference_transform="0 0 1 0 0 0 1")
    elsewhere = lidar_cloud("nowhere", [(0.0, 0.0, 2.0)])
    made = message_references(given, warnings.append, buffer)(elsewhere, 5.0)
    assert made.evidence(view, 5.0).measured.tolist() == [3.0]


def test_depth_of_another_frame_must_be_registered() -> None:
    warnings: list[str] = []
    buffer = TransformBuffer()
    beside = rigid(np.eye(3), np.array([0.025, 0.0, 0.0]))
    tied = transform(beside, 0, "camera", "depth"), transform(np.eye(4), 0, "camera", "aligned")
    buffer.take(tf_message(*tied), True)
    depth = Image(height=3, width=3, encoding="32FC1", step=12)
    depth.data = array.array("B", np.full((3, 3), 2.0, "<f4").tobytes())
    counts = []
    for pose in ("", "0 0 0 0 0 0 1"):
        options = ReferenceOptions(reference_type="Image", reference_transform=pose)
        make = message_references(options, warnings.append, buffer)
        for name in ("depth", "aligned", "camera", ""):
            depth.header.frame_id = name
            counts.append(len(make(depth, 5.0).evidence(small_view("camera"), 5.0).measured))
    assert counts == [0, 9, 9, 9, 9, 9, 9, 9]
    (warning,) = warnings
    assert "its frame_id is 'depth', the images are of 'camera', and tf has them apart" in warning


def test_messages_of_recordings_are_read_as_well() -> None:
    """rosbags gives plain objects with numpy arrays."""
    message = cloud(POINTS)
    plain = SimpleNamespace(
        **{name: getattr(message, name) for name in ("height", "width", "fields", "point_step")},
        row_step=message.row_step,
        is_bigendian=False,
        data=np.frombuffer(message.data, np.uint8),
    )
    np.testing.assert_array_equal(decode_points(plain), POINTS)


@pytest.mark.parametrize("number", [65.535, 65535.0])
def test_a_driver_s_largest_number_is_no_distance(number: float) -> None:
    points = decode_points(cloud([(1, 2, 3), (0, 0, number), (number, 1, 1)], step=16))
    assert np.isfinite(points).all(axis=1).tolist() == [True, False, False]
    scan = LaserScan(range_min=0.1, range_max=1e6, ranges=[1.0, number], angle_increment=0.1)
    assert np.isfinite(decode_scan(scan)).all(axis=1).tolist() == [True, False]
    sonar = Range(range=number, min_range=0.0, max_range=1e6, field_of_view=0.1)
    assert math.isnan(decode_range(sonar)[0])
    row = np.array([1.0, number], "<f4")
    image = Image(encoding="32FC1", height=1, width=2, step=8, data=array.array("B", row.tobytes()))
    found = decode_reference(image, "Image", parse_transform("", "Image"))
    assert isinstance(found, DepthReference)
    assert np.isfinite(found.depth).tolist() == [[True, False]]
