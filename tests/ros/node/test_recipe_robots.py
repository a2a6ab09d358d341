"""The recipe for two robots: two nodes that share nothing but the middleware."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack
from importlib.util import find_spec
from types import ModuleType

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from dyfn_ros.node.node import StreamDepthNode
from tests.support.launch_stand_in import ROOT, processes
from tests.support.node_here import SUCCESS, made_node, running_node
from tests.support.probe import Probe, stamped, statuses
from tests.support.recipe_scene import Scene, mount, picture, scene_depth
from tests.support.ros_graph import image_message, own_domain

LAUNCH = ROOT / "launch/robots.launch.py"
ROBOTS = ("alpha", "beta")
MADE = ["-p", "blank_contrast:=0.0", "-p", "frozen_after:=0.0", "-p", "diagnostics_period:=0.1"]


class Pair:
    """Both nodes, active, and a client that hears them."""

    def __init__(self, nodes: dict[str, StreamDepthNode], probe: Probe) -> None:
        self.nodes, self.probe = nodes, probe
        self.depths = {
            robot: probe.listen(f"/{robot}/stream_depth/depth/image", Image) for robot in nodes
        }
        self.diagnostics = probe.listen("/diagnostics", DiagnosticArray)
        self._stamp = 0

    def send(self, robot: str) -> None:
        """A picture, until the robot's node answers it."""
        image = picture(scene_depth(Scene(), mount(1.0, down=15)))
        before = len(self.depths[robot])
        for _ in range(100):
            self._stamp += 10**8
            message = stamped(image_message(image), self._stamp, "camera_optical")
            self.probe.publish(f"/{robot}/camera/image_raw", message)
            self.probe.spin_until(lambda: len(self.depths[robot]) > before, 0.3)
            if len(self.depths[robot]) > before:
                return
        raise AssertionError(f"{robot} does not answer")


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    lines = [one.command_line for one in processes(LAUNCH)]
    with own_domain() as domain, ExitStack() as stack:
        nodes = [stack.enter_context(running_node(domain, line + MADE)) for line in lines]
        probe = Probe(domain)
        stack.callback(probe.close)
        yield Pair(dict(zip(ROBOTS, nodes, strict=True)), probe)


def test_each_robot_has_its_namespace(pair: Pair) -> None:
    names = [node.get_fully_qualified_name() for node in pair.nodes.values()]
    assert names == ["/alpha/stream_depth", "/beta/stream_depth"]


def test_the_picture_of_one_robot_is_no_depth_of_the_other(pair: Pair) -> None:
    pair.send("alpha")
    assert pair.depths["alpha"]
    assert not pair.depths["beta"]
    pair.send("beta")
    assert {one.header.frame_id for one in pair.depths["beta"]} == {"camera_optical"}


def test_no_topic_but_the_shared_ones_belongs_to_both(pair: Pair) -> None:
    def published(robot: str) -> set[str]:
        node = pair.nodes[robot]
        found = node.get_publisher_names_and_types_by_node("stream_depth", f"/{robot}")
        return {name for name, _ in found}

    shared = published("alpha") & published("beta")
    assert shared == {"/diagnostics", "/parameter_events", "/rosout"}
    assert "/alpha/stream_depth/points" in published("alpha")


def test_diagnostics_name_the_robot(pair: Pair) -> None:
    known: set[str] = set()

    def both_told() -> bool:
        known.update(name for message in pair.diagnostics for name in statuses(message))
        return {f"{robot}/stream_depth: camera" for robot in ROBOTS} <= known

    pair.probe.wait(both_told, 20.0)
    assert all(name.startswith(("alpha/stream_depth", "beta/stream_depth")) for name in known)
    hardware = {status.name: status.hardware_id for m in pair.diagnostics for status in m.status}
    assert hardware["alpha/stream_depth: camera"] == "/alpha/camera/image_raw"


def test_a_service_of_one_robot_leaves_the_other_s_stream(pair: Pair) -> None:
    pair.send("alpha")
    pair.send("beta")
    client = pair.probe.node.create_client(Trigger, "/alpha/stream_depth/reset")
    pair.probe.wait(client.service_is_ready, 20.0)
    before = {robot: dict(node._cameras[0].resets) for robot, node in pair.nodes.items()}
    future = client.call_async(Trigger.Request())
    pair.probe.wait(future.done, 20.0)
    pair.send("alpha")
    pair.send("beta")
    after = {robot: dict(node._cameras[0].resets) for robot, node in pair.nodes.items()}
    assert after["alpha"] != before["alpha"]
    assert after["beta"] == before["beta"]


def test_each_robot_reads_its_own_tf_and_odometry(monkeypatch: pytest.MonkeyPatch) -> None:
    if find_spec("tf2_msgs") is None:  # no wheels have it; any type shows the topics
        messages = ModuleType("tf2_msgs.msg")
        messages.TFMessage = TransformStamped  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "tf2_msgs", ModuleType("tf2_msgs"))
        monkeypatch.setitem(sys.modules, "tf2_msgs.msg", messages)
    beta = processes(LAUNCH, params_file=str(ROOT / "config/cameras/odometry.yaml"))[1]
    with own_domain() as domain, made_node(domain, beta.command_line) as node:
        assert node.settings.metric_source == "odometry"
        assert node.trigger_configure() == SUCCESS
        for topic in ("/beta/tf", "/beta/tf_static", "/beta/odom"):
            assert node.count_subscribers(topic) > 0, topic
        for topic in ("/tf", "/tf_static", "/odom"):
            assert node.count_subscribers(topic) == 0, topic


def test_each_robot_has_its_view() -> None:
    found = processes(LAUNCH, robots="[a, b, c]", rviz="true", frame="base_link")
    views = [one for one in found if one.executable == "rviz2"]
    assert [one.namespace for one in views] == ["a", "b", "c"]
    for view in views:
        assert view.arguments[-2:] == ("-f", "base_link")
        assert view.remappings["/tf"] == "tf"
        assert view.remappings["/stream_depth/points"] == "stream_depth/points"
