"""The recipe for depthimage_to_laserscan: the scan that it makes of the node's depth image."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSCompatibility, qos_check_compatible, qos_profile_system_default
from sensor_msgs.msg import CameraInfo, Image

from tests.support.foreign_parameters import LASERSCAN
from tests.support.launch_stand_in import ROOT, processes
from tests.support.recipe_scene import Scene, mount, picture, scene_depth
from tests.support.recipe_stream import (
    OPTICAL_FRAME,
    RECIPES,
    RecipeStream,
    parameters_of,
    recipe_stream,
)

SCAN = parameters_of(RECIPES / "depthimage_to_laserscan.yaml", "depthimage_to_laserscan")
MOUNT = mount(height=0.6)  # level, as the recipe says
BOX = ((1.7, -0.3, 0.0), (1.9, 0.3, 1.0))
SCENE = Scene(box=BOX, wall=2.6)
KINDS = {"depth/image": Image, "depth/camera_info": CameraInfo}
DEPTH_STEP = 0.01  # metres; 8 bits of the picture, and a millimetre of 16UC1
METRES_PER_VALUE = {"32FC1": 1.0, "16UC1": 0.001}


@pytest.fixture(scope="module")
def stream() -> Iterator[RecipeStream]:
    with recipe_stream(RECIPES / "stream_depth_laserscan.yaml") as stream:
        yield stream


def scan_of(depth: Image, info: CameraInfo) -> tuple[np.ndarray, np.ndarray]:
    """What depthimage_to_laserscan computes: angles to the left, radians, and ranges, metres.

    It takes the focal length of P, the rows about the principal point, and of each pixel
    sqrt(x^2 + z^2) at the angle atan2(x, z); the nearest within the bounds counts, others are NaN.
    """
    assert depth.is_bigendian == 0
    kind = {"32FC1": np.float32, "16UC1": np.uint16}[depth.encoding]
    pixels = np.frombuffer(bytes(depth.data), kind).reshape(
        depth.height, depth.step // kind(0).nbytes
    )
    matrix = np.array(info.p).reshape(3, 4)
    focal, centre_x, centre_y = matrix[0, 0], matrix[0, 2], matrix[1, 2]
    rows = SCAN["scan_height"]
    assert rows / 2 <= min(centre_y, depth.height - centre_y), "scan_height is too large"
    first = int(centre_y - rows / 2)
    z = pixels[first : first + rows, : depth.width] * METRES_PER_VALUE[depth.encoding]
    u = np.arange(depth.width)
    ranges = np.hypot(z * (u - centre_x) / focal, z)
    inside = (ranges >= SCAN["range_min"]) & (ranges <= SCAN["range_max"])  # NaN is in neither
    low, high = (np.arctan2(s, focal) for s in (centre_x - depth.width + 1, centre_x))
    step = (high - low) / (depth.width - 1)
    found = np.full(depth.width, np.nan)
    index = ((-np.arctan2(u - centre_x, focal) - low) / step).astype(int)
    for column in u:
        if inside[:, column].any():
            nearest = ranges[inside[:, column], column].min()
            found[index[column]] = np.fmin(found[index[column]], nearest)
    return low + step * np.arange(depth.width), found


def scanned(stream: RecipeStream, encoding: str) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """-> the node's messages, and the points x ahead, y left of the scan in the camera's frame."""
    value = Parameter("depth_encoding", value=encoding)
    assert stream.node.set_parameters_atomically([value]).successful
    image = picture(scene_depth(SCENE, MOUNT))
    image[:, :6, 2] = 255  # PinholeModel finds nothing there
    answer = stream.frame(image, KINDS)
    assert answer["depth/image"].encoding == encoding
    angles, ranges = scan_of(answer["depth/image"], answer["depth/camera_info"])
    return answer, ranges * np.cos(angles), ranges * np.sin(angles)


@pytest.mark.parametrize("encoding", ["32FC1", "16UC1"])
def test_the_scan_is_the_wall_and_the_box(stream: RecipeStream, encoding: str) -> None:
    _, x, y = scanned(stream, encoding)
    hit = np.isfinite(x)
    of_box = hit & (abs(y) < BOX[1][1])
    of_wall = hit & (abs(y) > 0.6)  # beside the box's edges and their shadow
    assert of_box.sum() > 10
    assert of_wall.sum() > 20
    # An angle is that of a step of the scan, not of the pixel: up to one step beside it.
    np.testing.assert_allclose(x[of_box], BOX[0][0], atol=DEPTH_STEP + 0.01)
    step = 2 * np.arctan(np.tan(np.radians(35))) / 63
    np.testing.assert_allclose(
        x[of_wall], SCENE.wall, atol=DEPTH_STEP + abs(y[of_wall]).max() * step
    )


@pytest.mark.parametrize("encoding", ["32FC1", "16UC1"])
def test_pixels_without_depth_are_no_return(stream: RecipeStream, encoding: str) -> None:
    answer, x, _ = scanned(stream, encoding)
    values = np.frombuffer(
        bytes(answer["depth/image"].data), np.float32 if encoding == "32FC1" else np.uint16
    ).reshape(answer["depth/image"].height, -1)
    nothing = np.isnan(values) if encoding == "32FC1" else values == 0
    assert nothing[:, :6].all()
    assert not np.isfinite(x[-4:]).any()  # the picture's left is the scan's end


def test_the_floor_of_a_level_camera_is_no_wall(stream: RecipeStream) -> None:
    """The rows about the horizon do not see it; those of a camera that looks down do."""
    _, x, y = scanned(stream, "32FC1")
    assert np.nanmin(np.hypot(x, y)) > BOX[0][0] - DEPTH_STEP
    down = picture(scene_depth(SCENE, mount(height=1.0, down=25)))
    answer = stream.frame(down, KINDS)
    angles, ranges = scan_of(answer["depth/image"], answer["depth/camera_info"])
    assert abs(np.nanmax(ranges * np.cos(angles)) - SCENE.wall) > 0.1


def test_depth_and_camera_info_are_a_rectified_pair(stream: RecipeStream) -> None:
    answer, _, _ = scanned(stream, "32FC1")
    depth, info = answer["depth/image"], answer["depth/camera_info"]
    assert depth.header == info.header
    assert depth.header.frame_id == OPTICAL_FRAME
    assert (depth.height, depth.width) == (info.height, info.width)
    assert not any(info.d)
    np.testing.assert_array_equal(np.array(info.p).reshape(3, 4)[:, :3].reshape(-1), info.k)


def test_the_launch_file_connects_the_two_nodes(stream: RecipeStream) -> None:
    depth, scan = processes(ROOT / "launch/laserscan.launch.py", image="/camera/image_raw")
    assert depth.files == (RECIPES / "stream_depth_laserscan.yaml",)
    assert scan.files == (RECIPES / "depthimage_to_laserscan.yaml",)
    assert set(scan.remappings) == {"depth", "depth_camera_info", "scan"}
    for name, kind in (("depth", "Image"), ("depth_camera_info", "CameraInfo")):
        topic = f"/{scan.remappings[name]}"
        (publisher,) = stream.node.get_publishers_info_by_topic(topic)
        assert publisher.topic_type == f"sensor_msgs/msg/{kind}"
        offered = publisher.qos_profile
        found, reason = qos_check_compatible(offered, qos_profile_system_default)
        assert found != QoSCompatibility.ERROR, reason


def test_the_files_agree_and_have_parameters_that_are_declared(stream: RecipeStream) -> None:
    assert set(SCAN) <= LASERSCAN
    settings = stream.node.settings
    assert SCAN["scan_time"] == pytest.approx(1 / settings.max_rate)
    assert settings.until_metric == "withhold"
    assert SCAN["output_frame"] != OPTICAL_FRAME
