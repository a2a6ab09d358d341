"""The files of config/cameras with the commands in them, and images as those drivers send them."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from tests.support.node_here import running_node
from tests.support.probe import Probe, stamp_of, stamped
from tests.support.recipe_stream import ROOT
from tests.support.ros_graph import camera_info, frames, image_message, own_domain

CAMERAS = ROOT / "config/cameras"
RELIABLE = QoSProfile(depth=5)
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
PLUMB_BOB = (-0.05, 0.06, 0.001, -0.001, -0.02)
RATIONAL = (8.0, -12.0, 0.0, 0.0, 3.0, 7.9, -11.5, 2.8)  # near to no distortion


@dataclass(frozen=True)
class Driver:
    """What a driver sends: the encoding ("jpeg" is compressed), its QoS, its calibration.

    d: of the lens; None: an uncalibrated driver, K is 0. info_frame: of its camera_info.
    """

    encoding: str
    qos: QoSProfile
    d: tuple[float, ...] | None = (0.0,) * 5
    info_frame: str = "optical"
    lens: str = "plumb_bob"


DRIVERS = {
    "gazebo": Driver("rgb8", BEST_EFFORT, info_frame="camera_link"),
    "hololens": Driver("jpeg", RELIABLE),
    "oak_d": Driver("jpeg", RELIABLE, RATIONAL, lens="rational_polynomial"),
    "odometry": Driver("rgb8", RELIABLE),
    "realsense": Driver("rgb8", RELIABLE, PLUMB_BOB),
    "two_cameras": Driver("rgb8", BEST_EFFORT),
    "usb_cam": Driver("yuv422_yuy2", BEST_EFFORT, d=None, info_frame=""),
    "zed_left": Driver("bgra8", RELIABLE),
}


def command(file: Path) -> dict[str, str]:
    """The remappings of the command in a file's comments."""
    comments = re.findall(r"^#(.*)$", file.read_text(encoding="utf-8"), flags=re.MULTILINE)
    words = shlex.split(" ".join(comments).replace("\\ ", " ").replace("'", ""))
    start = words.index("--params-file")
    assert words[start + 1] == file.name
    pairs = [words[i + 1] for i, word in enumerate(words) if word == "-r"]
    return dict(pair.split(":=") for pair in pairs)


def image(driver: Driver, rgb: np.ndarray) -> Image | CompressedImage:
    if driver.encoding == "jpeg":
        done, data = cv2.imencode(".jpg", rgb[..., ::-1])
        assert done
        return CompressedImage(format="rgb8; jpeg compressed bgr8", data=data.tobytes())
    if driver.encoding == "yuv422_yuy2":
        height, width = rgb.shape[:2]
        pixels = np.full((height, width, 2), 128, np.uint8)
        pixels[..., 0] = rgb[..., 0]
        return image_message(pixels, driver.encoding)
    if driver.encoding == "bgra8":
        return image_message(
            np.dstack([rgb[..., ::-1], np.full(rgb.shape[:2], 255, np.uint8)]), "bgra8"
        )
    return image_message(rgb, driver.encoding)


def calibration(driver: Driver) -> CameraInfo:
    info = camera_info()
    if driver.d is None:
        info.k, info.p = [0.0] * 9, [0.0] * 12
    else:
        info.d, info.distortion_model = list(driver.d), driver.lens
    return info


def depth_of(
    probe: Probe, driver: Driver, topics: dict[str, str], prefix: str
) -> tuple[int, Image, CameraInfo]:
    """Send the driver's messages until a depth comes; -> the stamp, and what came with it."""
    message = image(driver, frames(1)[0])
    topic, info_topic = topics[f"{prefix}image"], topics[f"{prefix}camera_info"]
    if isinstance(message, CompressedImage):
        topic += "/compressed"
    for one in (topic, info_topic):
        probe.wait(lambda one=one: probe.node.count_subscribers(one), 20.0)
    depths = probe.listen(f"{prefix}depth/image", Image)
    infos = probe.listen(f"{prefix}depth/camera_info", CameraInfo)
    for stamp in range(10**8, 100 * 10**8, 10**8):
        info = stamped(calibration(driver), stamp, driver.info_frame)
        probe.publish(info_topic, info, driver.qos)
        probe.publish(topic, stamped(message, stamp), driver.qos)
        probe.spin_until(lambda: depths and infos, 0.2)
        if depths and infos:
            return stamp, depths[-1], infos[-1]
    raise AssertionError("no depth came")


@pytest.mark.parametrize("name", DRIVERS)
def test_a_driver_s_images_become_depth(name: str) -> None:
    file, driver = CAMERAS / f"{name}.yaml", DRIVERS[name]
    topics = command(file)
    line = ["--params-file", str(file), "-p", "metric_source:=none", "-p", "blank_contrast:=0.0"]
    for ours, theirs in topics.items():
        line += ["-r", f"{ours}:={theirs}"]
    with own_domain() as domain, running_node(domain, line) as node:
        probe = Probe(domain)
        camera = node.settings.cameras[0]
        try:
            stamp, depth, info = depth_of(probe, driver, topics, f"{camera}/" if camera else "")
        finally:
            probe.close()
    assert stamp_of(depth) <= stamp
    assert depth.header.frame_id == info.header.frame_id == "optical"
    assert (depth.height, depth.width) == (36, 48)
    expected = camera_info().k
    if driver.d is None:
        assert info.k[0] > 0
        assert info.k[0] != expected[0]  # estimated
    else:
        np.testing.assert_array_equal(info.k, expected)
    assert not any(info.d) or node.settings.distortion == "ignore"


def test_every_file_has_its_driver() -> None:
    assert {path.stem for path in CAMERAS.glob("*")} == set(DRIVERS)


@pytest.mark.parametrize("name", DRIVERS)
def test_a_file_leaves_the_reliability_to_the_driver(name: str) -> None:
    """A best-effort subscription loses half of the large images of a reliable driver."""
    text = (CAMERAS / f"{name}.yaml").read_text(encoding="utf-8")
    assert "best_effort" not in text
