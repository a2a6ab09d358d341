"""The recipe for RTAB-Map: image, depth and camera_info are what its exact synchronizer pairs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import yaml
from rclpy.qos import QoSCompatibility, qos_check_compatible, qos_profile_system_default
from sensor_msgs.msg import CameraInfo, Image

from tests.support.foreign_parameters import RGBD_SYNC, RTABMAP, RTABMAP_OWN
from tests.support.launch_stand_in import ROOT, Process, processes
from tests.support.probe import stamp_of, stamped
from tests.support.recipe_scene import Scene, mount, picture, scene_depth
from tests.support.recipe_stream import (
    OPTICAL_FRAME,
    RECIPES,
    RecipeStream,
    parameters_of,
    recipe_stream,
)
from tests.support.ros_graph import image_message

FILE = RECIPES / "rtabmap.yaml"
SYNC, SLAM = parameters_of(FILE, "rgbd_sync"), parameters_of(FILE, "rtabmap")
MOUNT = mount(height=1.0, down=15)
SCENE = Scene(box=((1.7, -0.3, 0.0), (1.9, 0.3, 0.4)))
KINDS = {"depth/image": Image, "depth/camera_info": CameraInfo}
IMAGE = "/camera/image_rect"


@pytest.fixture(scope="module")
def stream() -> Iterator[RecipeStream]:
    with recipe_stream(RECIPES / "stream_depth_rtabmap.yaml", image=IMAGE) as stream:
        yield stream


@pytest.fixture(scope="module")
def started() -> dict[str, Process]:
    found = processes(ROOT / "launch/rtabmap.launch.py", image=IMAGE)
    return {one.executable: one for one in found}


def exactly_paired(*topics: list[int], queue: int) -> list[int]:
    """Stamps that message_filters' ExactTime lets through, each topic's newest `queue` kept.

    topics: stamps in the order in which they come, the later topics after the earlier ones.
    """
    kept = [stamps[-queue:] for stamps in topics]
    return sorted(set(kept[0]).intersection(*kept[1:]))


def test_depth_is_in_millimetres_and_registered_to_the_image(stream: RecipeStream) -> None:
    truth = scene_depth(SCENE, MOUNT)
    depth = stream.frame(picture(truth), KINDS)["depth/image"]
    assert depth.encoding == "16UC1"  # RTAB-Map reads it as millimetres
    assert (depth.height, depth.width) == truth.shape
    assert depth.step == 2 * depth.width
    values = np.frombuffer(bytes(depth.data), np.uint16).reshape(truth.shape)
    np.testing.assert_allclose(values, 1000 * truth, atol=8)
    assert SYNC.get("depth_scale", 1.0) == 1.0


def test_image_depth_and_camera_info_have_one_stamp_and_one_frame(stream: RecipeStream) -> None:
    answer = stream.frame(picture(scene_depth(SCENE, MOUNT)), KINDS)
    depth, info = answer["depth/image"], answer["depth/camera_info"]
    assert stamp_of(depth) == stamp_of(info) == stream.stamp  # the image's
    assert depth.header.frame_id == info.header.frame_id == OPTICAL_FRAME
    assert (info.height, info.width) == (depth.height, depth.width)
    assert not any(info.d)


def test_every_depth_finds_its_image_in_the_queues(stream: RecipeStream) -> None:
    """Of a camera of 30 Hz, of which the node takes a part; the rest has no depth."""
    image = picture(scene_depth(SCENE, MOUNT))
    stream.frame(image, KINDS)
    start, sent = stream.stamp + 10**9, []
    for number in range(SYNC["topic_queue_size"]):
        sent.append(start + number * 33_333_333)
        stream.probe.publish(IMAGE, stamped(image_message(image), sent[-1], OPTICAL_FRAME))
        stream.probe.spin_until(lambda: False, 0.01)

    def stamps(topic: str) -> list[int]:
        return [stamp_of(m) for m in stream.probe.received[topic] if stamp_of(m) >= start]

    depth, info = KINDS

    def all_came() -> bool:
        return stamps(depth)[-1:] > [sent[-4]] and stamps(depth) == stamps(info)

    stream.probe.wait(all_came, 20.0)
    paired = exactly_paired(sent, stamps(depth), stamps(info), queue=SYNC["sync_queue_size"])
    assert paired == stamps(depth)
    assert 5 <= len(paired) <= 11  # of a second, by max_rate
    assert SYNC["approx_sync"] is False


def test_the_launch_file_connects_the_nodes(
    stream: RecipeStream, started: dict[str, Process]
) -> None:
    assert set(started) == {"stream_depth", "rgbd_sync", "rtabmap"}
    sync = started["rgbd_sync"]
    assert sync.remappings["rgb/image"] == IMAGE == started["stream_depth"].remappings["image"]
    for name, kind in (("depth/image", "Image"), ("rgb/camera_info", "CameraInfo")):
        (publisher,) = stream.node.get_publishers_info_by_topic(f"/{sync.remappings[name]}")
        assert publisher.topic_type == f"sensor_msgs/msg/{kind}"
        offered = publisher.qos_profile
        found, reason = qos_check_compatible(offered, qos_profile_system_default)
        assert found != QoSCompatibility.ERROR, reason
    assert sync.namespace == started["rtabmap"].namespace  # rgbd_image is relative
    assert {one.package for one in started.values()} == {"dyfn_ros", "rtabmap_sync", "rtabmap_slam"}


def test_the_files_have_parameters_that_are_declared() -> None:
    assert set(SYNC) <= RGBD_SYNC
    own = {name: value for name, value in SLAM.items() if "/" in name}
    assert set(own) <= RTABMAP_OWN
    assert set(SLAM) - set(own) <= RTABMAP
    assert all(isinstance(value, str) for value in own.values())  # else rtabmap does not start
    assert yaml.safe_load(FILE.read_text()).keys() == {"/**/rgbd_sync", "/**/rtabmap"}


def test_the_map_is_made_of_what_the_node_lets_through(stream: RecipeStream) -> None:
    settings = stream.node.settings
    assert settings.max_depth >= float(SLAM["Grid/RangeMax"])
    assert settings.until_metric == "withhold"
    assert settings.output_scale == 1.0
    assert settings.rectified
