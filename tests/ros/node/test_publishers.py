"""Whoever publishes, with whatever QoS: images and intrinsics come, and what is lost is told."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import (
    DurabilityPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from sensor_msgs.msg import CameraInfo, Image

from tests.support.probe import Probe, stamp_of, stamped, statuses
from tests.support.ros_graph import (
    NodeProcess,
    camera_info,
    frames,
    image_message,
    own_domain,
    tiny_node,
)

PLAIN = 10  # what `create_publisher(Image, topic, 10)` has: reliable, the last ten
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
Start = Callable[..., tuple[NodeProcess, Probe]]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Starts a node and a probe that hears its depth and its diagnostics."""
    with own_domain() as environment:
        probe = Probe(environment)
        nodes: list[NodeProcess] = []

        def begin(**parameters: Any) -> tuple[NodeProcess, Probe]:
            nodes.append(tiny_node(environment, tmp_path, diagnostics_period=0.2, **parameters))
            probe.listen("depth/image", Image)
            probe.listen("/diagnostics", DiagnosticArray)
            probe.listen("depth/camera_info", CameraInfo)
            return nodes[0], probe

        yield begin
        code = nodes[0].end()
        probe.close()
        assert code == 0, nodes[0].log
        assert "Traceback" not in nodes[0].log


def camera(probe: Probe) -> tuple[str, dict[str, str]]:
    """The camera's diagnostics, the next that come."""
    known = probe.received["/diagnostics"]
    count = len(known)
    probe.wait(lambda: len(known) > count)
    return statuses(known[-1])["stream_depth: camera"]


def known(probe: Probe, publisher: Any) -> None:
    """Until the node and the probe see each other; the node hears the probe's depth topics."""
    probe.wait(lambda: publisher.get_subscription_count() >= 1)
    probe.wait(lambda: probe.node.count_publishers("/stream_depth/depth/image") == 1)
    camera(probe)
    assert probe.set("publish_points", True).successful


LARGE = frames(1, 480, 640)[0]


def test_no_frame_of_a_plain_driver_is_lost(start: Start) -> None:
    _, probe = start()
    publisher = probe.node.create_publisher(Image, "/image", PLAIN)
    known(probe, publisher)
    depths = probe.received["depth/image"]
    for index in range(12):  # one at a time
        publisher.publish(stamped(image_message(LARGE), index + 1))
        probe.wait(lambda index=index: index + 1 in map(stamp_of, depths), 60.0)
    for index in range(30):  # 15 a second, whether the node follows or not
        publisher.publish(stamped(image_message(LARGE), 100 + index))
        probe.spin_until(lambda: False, 1 / 15)

    def all_came() -> bool:
        values = camera(probe)[1]
        return int(values["received"]) == 42 == int(values["published"]) + int(values["dropped"])

    probe.wait(all_came, 60.0)
    assert camera(probe)[1]["lost on the way"] == "0"


def test_reliability_follows_the_publishers_as_they_come_and_go(start: Start) -> None:
    node, probe = start()
    stamp = 0

    def frames_pass() -> None:
        nonlocal stamp
        depths = probe.received["depth/image"]
        count = len(depths)

        def one_more() -> bool:
            nonlocal stamp
            stamp += 1_000_000
            publishers[-1].publish(stamped(image_message(frames(1)[0]), stamp))
            probe.spin_until(lambda: len(depths) > count, 0.5)
            return len(depths) > count

        probe.wait(one_more)

    def becomes(reliability: str) -> None:
        probe.wait(lambda: camera(probe)[1]["reliability"] == reliability)
        frames_pass()

    publishers = [probe.node.create_publisher(Image, "/image", qos_profile_sensor_data)]
    becomes("best effort")
    publishers.append(probe.node.create_publisher(Image, "/image", PLAIN))
    becomes("best effort")  # both must be heard
    probe.node.destroy_publisher(publishers.pop(0))
    becomes("reliable")
    publishers.append(probe.node.create_publisher(Image, "/image", BEST_EFFORT))
    becomes("best effort")
    assert "incompatible" not in node.log


def test_no_frame_is_lost_or_comes_twice_while_the_reliability_changes(start: Start) -> None:
    _, probe = start(drop_frames=False)
    other = probe.node.create_publisher(Image, "/image", BEST_EFFORT)
    publisher = probe.node.create_publisher(Image, "/image", PLAIN)
    known(probe, publisher)
    probe.wait(lambda: camera(probe)[1]["reliability"] == "best effort")
    probe.node.destroy_publisher(other)
    count, reliable = 0, False
    while not reliable or count % 20:  # until well after the change
        count += 1
        publisher.publish(stamped(image_message(frames(1)[0]), count * 10**8))
        probe.spin_until(lambda: False, 0.05)
        reliable = camera(probe)[1]["reliability"] == "reliable"
    depths = probe.received["depth/image"]
    probe.wait(lambda: len(depths) >= count)
    assert sorted(map(stamp_of, depths)) == [(n + 1) * 10**8 for n in range(count)]
    assert camera(probe)[1]["received"] == str(count)


def test_images_that_are_lost_on_the_way_are_a_warning_with_advice(start: Start) -> None:
    """A node that stands still loses best-effort images, more than the transport's buffers hold."""
    node, probe = start()
    publisher = probe.node.create_publisher(Image, "/image", BEST_EFFORT)
    known(probe, publisher)

    def told() -> bool:
        node.process.send_signal(signal.SIGSTOP)
        for _ in range(80):
            publisher.publish(stamped(image_message(LARGE), time.time_ns()))
        node.process.send_signal(signal.SIGCONT)
        publisher.publish(stamped(image_message(LARGE), time.time_ns()))  # by this the gap is seen
        camera(probe)
        found = [statuses(m)["stream_depth: camera"] for m in probe.received["/diagnostics"]]
        advice = "lost on the way: not every publisher offers reliable"
        return any(advice in text and int(values["lost on the way"]) for text, values in found)

    probe.wait(told)


@pytest.mark.parametrize(
    ("parameters", "moment"),
    [
        ({}, "before"),
        ({"wait_for_camera_info": True}, "before"),
        (
            {"qos_overrides./camera_info.subscription.durability": "transient_local"},
            "after",
        ),
    ],
    ids=["as it is", "waiting", "overridden"],
)
def test_a_latched_camera_info_is_received(
    start: Start, parameters: dict[str, Any], moment: str
) -> None:
    """Published once, before the node is there, or while it runs."""
    _, probe = start(**parameters)

    def publish_info() -> Any:
        publisher = probe.node.create_publisher(CameraInfo, "/camera_info", LATCHED)
        publisher.publish(stamped(camera_info(), 0))
        return publisher

    infos = [publish_info()] if moment == "before" else []
    images = probe.node.create_publisher(Image, "/image", PLAIN)
    known(probe, images)
    infos = infos or [publish_info()]
    found = probe.received["depth/camera_info"]

    def intrinsics() -> bool:
        images.publish(stamped(image_message(frames(1)[0]), time.time_ns()))
        probe.spin_until(lambda: False, 0.1)
        return bool(found) and found[-1].k[0] == 40.0

    probe.wait(intrinsics)
    if "wait_for_camera_info" in parameters:
        assert {info.k[0] for info in found} == {40.0}


def test_frames_that_wait_for_a_camera_info_are_a_warning(start: Start) -> None:
    node, probe = start(wait_for_camera_info=True)
    images = probe.node.create_publisher(Image, "/image", PLAIN)
    known(probe, images)

    def told() -> bool:
        images.publish(stamped(image_message(frames(1)[0]), time.time_ns()))
        return "frames are held until a CameraInfo comes on /camera_info" in camera(probe)[0]

    probe.wait(told)
    assert "frames are held until a CameraInfo comes on /camera_info" in node.log
    assert not probe.received["depth/image"]


def test_the_log_says_what_is_waited_for_and_which_parameter_is_without_effect(
    start: Start,
) -> None:
    node, _ = start(
        **{
            "metric_sorce": "odometry",
            "front.max_depth": 3.0,
            "qos_overrides./imgae.subscription.depth": 3,
            "qos_overrides./image.subscription.colour": "red",
            "qos_overrides./image.subscription.depth": 3,
        }
    )
    node.wait_log(r"INFO\].*waiting for images on /image \(nobody publishes it yet\)")
    for name in ("/imgae.subscription.depth", "/image.subscription.colour"):
        node.wait_log(rf"WARN\].*qos_overrides.{name} was given, but .* it has no effect")
    assert "/image.subscription.depth was given" not in node.log
    for name, reason in (
        ("metric_sorce", "there is no parameter 'metric_sorce'; did you mean 'metric_source'?"),
        ("front.max_depth", "there is no camera 'front'; cameras is []"),
    ):
        assert f"{name} was given and has no effect: {reason}" in node.log
    assert node.log.count("was given and has no effect") == 2
