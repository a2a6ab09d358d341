"""States of the node, time that jumps, and what must not bring it down."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger

from tests.support.probe import Probe, stamp_of, stamped, statuses
from tests.support.ros_graph import (
    RELIABLE,
    NodeProcess,
    frames,
    image_message,
    own_domain,
    tiny_node,
)

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Setup:
    """A domain with a folder, its nodes and its probes."""

    def __init__(self, environment: dict[str, str], folder: Path) -> None:
        self.environment, self.folder = environment, folder
        self.nodes: list[NodeProcess] = []
        self.probes: list[Probe] = []

    def node(self, **parameters: Any) -> NodeProcess:
        folder = self.folder / str(len(self.nodes))
        folder.mkdir()
        self.nodes.append(tiny_node(self.environment, folder, **parameters))
        return self.nodes[-1]

    def probe(self) -> Probe:
        self.probes.append(Probe(self.environment, f"probe{len(self.probes)}"))
        return self.probes[-1]


@pytest.fixture
def setup(tmp_path: Path) -> Iterator[Setup]:
    with own_domain() as environment:
        setup = Setup(environment, tmp_path)
        yield setup
        for probe in setup.probes:
            probe.close()
        for node in setup.nodes:
            node.kill()


def send(probe: Probe, stamp: int, qos: QoSProfile = RELIABLE) -> int:
    probe.publish("/image", stamped(image_message(frames(1)[0]), stamp), qos)
    return stamp


def answered(probe: Probe, stamp: int, qos: QoSProfile = RELIABLE) -> Any:
    """Send frames from this stamp on, a millisecond apart, until one comes back; -> it.

    With time between them: a slow machine must not have to work off a queue.
    """
    depths = probe.received["depth/image"]
    count = len(depths)

    def one_more() -> bool:
        nonlocal stamp
        stamp = send(probe, stamp + 1_000_000, qos)
        probe.spin_until(lambda: len(depths) > count, 1.0)
        return len(depths) > count

    probe.wait(one_more)
    return depths[-1]


def test_the_states_of_a_managed_node(setup: Setup) -> None:
    """Silent until active, silent after; cleaned up, it may be given another model."""
    node = setup.node(autostart=False, drop_frames=False, model="nothing", diagnostics_period=0.1)
    probe = setup.probe()
    depths = probe.listen("depth/image", Image)
    diagnostics = probe.listen("/diagnostics", DiagnosticArray)

    def ignored(count: int) -> bool:
        latest = statuses(diagnostics[-1]) if diagnostics else {}
        values = latest.get("stream_depth: camera", ("", {}))[1]
        return values.get("received while inactive") == str(count)

    assert probe.state() == "unconfigured"
    assert not probe.change("configure")
    assert "model 'nothing' is unknown" in node.wait_log("cannot configure.*")
    assert probe.state() == "unconfigured"
    assert probe.set("model", "tiny").successful
    assert probe.set("device", "cuda:99").successful
    assert not probe.change("configure")
    node.wait_log("cannot configure: no device 'cuda:99' here")
    assert probe.set("device", "cpu").successful
    assert probe.change("configure")
    assert probe.state() == "inactive"
    refused = probe.set("model", "other")
    assert (refused.successful, "unconfigured" in refused.reason) == (False, True)
    send(probe, 1)
    probe.wait(lambda: ignored(1))
    assert probe.change("activate")
    first = answered(probe, 1_000)
    assert stamp_of(first) > 1_000
    assert 1 not in map(stamp_of, depths)

    assert probe.change("deactivate")
    count = len(depths)
    send(probe, 2_000_000_000)
    probe.wait(lambda: ignored(2))
    assert probe.state() == "inactive"
    assert probe.change("activate")
    answered(probe, 2_100_000_000)
    assert 2_000_000_000 not in map(stamp_of, depths[count:])

    assert probe.change("deactivate")
    assert probe.change("cleanup")
    assert probe.state() == "unconfigured"
    probe.wait(lambda: probe.node.count_publishers("/stream_depth/depth/image") == 0)
    assert probe.change("configure")
    assert probe.change("activate")
    answered(probe, 3_000_000_000)
    assert probe.change("active_shutdown") or probe.change("shutdown")
    assert probe.state() == "finalized"
    assert node.end() == 0, node.log
    assert "Traceback" not in node.log


def test_a_jump_of_ros_time_resets_the_stream(setup: Setup) -> None:
    """Stamps go on as if nothing had happened; only /clock says that the world was reset."""
    node = setup.node(use_sim_time=True, drop_frames=False)
    probe = setup.probe()
    probe.listen("depth/image", Image)
    resets = probe.listen("resets", DiagnosticArray, LATCHED)

    def clock(seconds: int) -> None:
        message = Clock()
        message.clock.sec = seconds
        probe.publish("/clock", message)

    def jumped() -> bool:
        nonlocal seconds
        clock(seconds)
        clock(seconds - 50)
        answered(probe, stamp_of(probe.received["depth/image"][-1]))
        return bool(resets)

    clock(100)
    answered(probe, 100 * 10**9)
    seconds = 100
    probe.wait(jumped)
    assert resets[0].status[0].message == "ROS time jumped"
    assert node.end() == 0, node.log


def test_it_outlives_publishers_resets_and_a_subscriber_that_does_not_read(setup: Setup) -> None:
    node = setup.node(diagnostics_period=0.2)
    lazy = setup.probe()
    lazy.listen("points", PointCloud2)  # and never spins
    for start in (10, 20, 30):
        publisher = setup.probe()
        publisher.listen("depth/image", Image)
        answered(publisher, start * 10**9, qos_profile_sensor_data)
        publisher.close()
        setup.probes.remove(publisher)
    probe = setup.probe()
    probe.listen("depth/image", Image)
    diagnostics = probe.listen("/diagnostics", DiagnosticArray)
    client = probe.node.create_client(Trigger, "/stream_depth/reset")
    probe.wait(client.service_is_ready)
    for burst in range(40):  # a service's queues hold ten, and lose what is more
        futures = [client.call_async(Trigger.Request()) for _ in range(8)]
        send(probe, 40 * 10**9 + burst * 10**6, qos_profile_sensor_data)
        probe.wait(lambda futures=futures: all(future.done() for future in futures))
        assert all(future.result().success for future in futures)
    answered(probe, 41 * 10**9, qos_profile_sensor_data)
    count = len(diagnostics)
    probe.wait(lambda: len(diagnostics) > count)
    values = statuses(diagnostics[-1])["stream_depth: camera"][1]
    assert (values["failed"], values["bad"]) == ("0", "0")
    assert int(values["resets: reset service"]) >= 1
    assert node.end() == 0, node.log


def test_after_kill_nine_another_one_takes_over(setup: Setup) -> None:
    probe = setup.probe()
    probe.listen("depth/image", Image)
    for start in (10, 20):
        node = setup.node()
        answered(probe, start * 10**9, qos_profile_sensor_data)
        if start == 10:
            assert node.end(signal.SIGKILL) == -signal.SIGKILL  # DDS takes it for alive a while
    assert node.end() == 0, node.log
