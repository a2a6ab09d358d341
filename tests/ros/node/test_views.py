"""The files for RViz and Foxglove show what the node publishes, with the README's remapping."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible

from dyfn_ros.node.node import StreamDepthNode
from tests.support.node_here import SUCCESS, made_node
from tests.support.ros_graph import own_domain
from tests.support.views import CONFIG, of_foxglove, of_rviz

README = CONFIG.parent / "README.md"
VIEWS = {"stream_depth.rviz": of_rviz, "stream_depth.foxglove.json": of_foxglove}
RELIABILITIES = {
    "Best Effort": ReliabilityPolicy.BEST_EFFORT,
    "Reliable": ReliabilityPolicy.RELIABLE,
}


@pytest.fixture(scope="module")
def node() -> Iterator[StreamDepthNode]:
    command = r"^ +ros2 run dyfn_ros stream_depth --ros-args (.*)$"
    (line,) = re.findall(command, README.read_text(), flags=re.MULTILINE)
    with own_domain() as domain, made_node(domain, line.split()) as node:
        assert node.trigger_configure() == SUCCESS
        yield node


@pytest.mark.parametrize("name", VIEWS)
def test_what_is_shown_is_there(node: StreamDepthNode, name: str) -> None:
    topics = dict(node.get_topic_names_and_types())
    shown = list(VIEWS[name](CONFIG / name))
    assert {one.topic for one in shown} >= {"/camera/image_raw", "/stream_depth/points"}
    for one in shown:
        assert one.kind in topics.get(one.topic, ()), one
        assert one.fixed is not False, f"{one.topic}: the colours follow the depth"
    assert any(one.fixed for one in shown)


def test_rviz_can_be_connected(node: StreamDepthNode) -> None:
    outputs = [s for s in of_rviz(CONFIG / "stream_depth.rviz") if "/stream_depth/" in s.topic]
    assert len(outputs) == 2
    for one in outputs:
        (publisher,) = node.get_publishers_info_by_topic(one.topic)
        wanted = QoSProfile(depth=5, reliability=RELIABILITIES[one.reliability])
        found, reason = qos_check_compatible(publisher.qos_profile, wanted)
        assert found != QoSCompatibility.ERROR, reason


def test_colours_that_follow_the_depth_are_found(tmp_path: Path) -> None:
    changed = tmp_path / "changed.rviz"
    text = (CONFIG / "stream_depth.rviz").read_text()
    changed.write_text(text.replace("Normalize Range: false", "Normalize Range: true"))
    assert False in {one.fixed for one in of_rviz(changed)}
