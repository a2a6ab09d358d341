"""The node's metric scale, scene cuts and state files, through a real graph on loopback."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from dyfn_ros.messages import images as messages
from dyfn_ros.messages.clouds import cloud_points
from tests.support.odometry import base_pose, odometry
from tests.support.points import cloud_message
from tests.support.ros_graph import (
    NODE,
    RELIABLE,
    Client,
    NodeProcess,
    camera_info,
    frames,
    own_domain,
    tiny_node,
)

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@dataclass
class Bench:
    """A domain, its nodes, and what the current client has heard besides depth."""

    domain: dict[str, str]
    folder: Path
    nodes: list[NodeProcess] = field(default_factory=list)
    client: Client | None = None
    scales: list[float] = field(default_factory=list)
    statuses: list[DiagnosticStatus] = field(default_factory=list)
    resets: list[str] = field(default_factory=list)

    def start(self, **parameters: Any) -> Client:
        """A node that works on every frame, and a client that has seen it."""
        if self.client is not None:
            self.client.close()
        folder = self.folder / str(len(self.nodes))
        folder.mkdir()
        self.nodes.append(tiny_node(self.domain, folder, drop_frames=False, **parameters))
        client = self.client = Client(self.domain)
        subscribe = client.node.create_subscription
        heard: list[tuple[type, str, Callable[[Any], None]]] = [
            (Float64, "scale", lambda m: self.scales.append(m.data)),
            (DiagnosticStatus, "scale/status", self.statuses.append),
            (DiagnosticArray, "resets", lambda m: self.resets.append(m.status[0].message)),
        ]
        for kind, topic, take in heard:
            client.subscriptions.append(subscribe(kind, f"{NODE}/{topic}", take, LATCHED))
        client.prime()
        return client

    def end(self, number: int = signal.SIGINT) -> None:
        self.nodes[-1].end(number)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with own_domain() as domain:
        bench = Bench(domain, tmp_path)
        yield bench
        if bench.client is not None:
            bench.client.close()
        for node in bench.nodes:
            node.kill()


def depth_of(result: dict[str, Any]) -> np.ndarray:
    return messages.decode_depth(result["depth/image"])


def call(client: Client, name: str) -> Trigger.Response:
    return client._call(client.node.create_client(Trigger, f"{NODE}/{name}"), Trigger.Request())


def value(bench: Bench, key: str) -> str:
    """Of the last scale status."""
    return next(v.value for v in bench.statuses[-1].values if v.key == key)


def test_reference_topic_turns_relative_depth_into_metres(bench: Bench) -> None:
    """Withheld at first, metres after the calibration, kept or withheld after a reset."""
    client = bench.start(
        metric_source="reference",
        calibration_seconds=2.0,
        reference_tolerance=0.2,
        reference_disagreement=3.0,
        max_gap=0.0,
        frozen_after=0.0,  # the same picture again and again
    )
    cloud = client.node.create_publisher(PointCloud2, "reference", RELIABLE)
    client.wait(lambda: cloud.get_subscription_count() == 1)
    client.send_info(camera_info())
    picture = frames(1)[0]
    stamp = client.send(picture)
    withheld = client.result(stamp)
    assert np.isnan(depth_of(withheld)).all()
    client.wait(lambda: bool(bench.statuses) and bool(bench.scales))
    assert math.isnan(bench.scales[-1])
    assert bench.statuses[-1].level == DiagnosticStatus.WARN
    assert (value(bench, "unit"), value(bench, "source")) == ("relative", "reference")

    assert client.set_parameter("until_metric", "relative").successful
    relative = cloud_points(client.result(client.send(picture))["points"])
    xyz = np.stack([relative[axis] for axis in "xyz"], -1).reshape(-1, 3)
    xyz = xyz[np.isfinite(xyz).all(1)]
    known = 3.0 * xyz[:: max(1, len(xyz) // 60)]

    def calibrated() -> bool:
        ahead = client._stamp + 1
        cloud.publish(cloud_message(known, (ahead, 500_000_000 + ahead)))
        client.settle()
        client.result(client.send(picture))
        return bool(bench.scales) and math.isfinite(bench.scales[-1])

    client.wait(calibrated)
    scale = bench.scales[-1]
    assert 0.5 < scale < 20
    metric = depth_of(client.result(client.send(picture)))
    assert np.isfinite(metric).any()
    client.wait(lambda: float(value(bench, "age").removesuffix(" s")) > 0.5)
    assert (value(bench, "unit"), value(bench, "source")) == ("metres", "reference")
    assert float(value(bench, "scale")) == pytest.approx(scale, rel=1e-4)
    assert int(value(bench, "points")) >= 10
    assert math.isfinite(float(value(bench, "spread")))

    answer = call(client, "calibrate")
    assert answer.success
    assert f"until then {scale:.4g} stays in force" in answer.message
    assert np.isfinite(depth_of(client.result(client.send(picture)))).any()
    client.wait(lambda: "before the calibration that was asked for" in bench.statuses[-1].message)
    client.wait(lambda: calibrated() and bench.statuses[-1].level == DiagnosticStatus.OK)
    scale = bench.scales[-1]

    client.reset()
    kept = depth_of(client.result(client.send(picture)))
    assert np.isfinite(kept).any()
    client.wait(lambda: bench.scales[-1] == scale)
    client.wait(lambda: bench.statuses[-1].level == DiagnosticStatus.WARN)
    assert "kept from before a reset" in bench.statuses[-1].message

    assert client.set_parameter("until_metric", "withhold").successful
    assert client.set_parameter("after_reset", "withhold").successful
    client.reset()
    assert np.isnan(depth_of(client.result(client.send(picture)))).all()


def test_odometry_without_the_camera_s_place_is_said_and_depth_goes_on(bench: Bench) -> None:
    client = bench.start(metric_source="odometry", until_metric="relative")
    found: list[DiagnosticArray] = []
    client.subscriptions.append(
        client.node.create_subscription(DiagnosticArray, "/diagnostics", found.append, RELIABLE)
    )
    publisher = client.node.create_publisher(Odometry, "odometry", RELIABLE)
    client.wait(lambda: publisher.get_subscription_count() == 1)
    for offset in (-0.1, 0.1):
        publisher.publish(odometry(base_pose(offset), client._stamp + 1.5 + offset))
    client.settle()
    assert np.isfinite(depth_of(client.result(client.send(frames(1)[0])))).any()
    bench.nodes[-1].wait_log(r"/odometry: no pose of the camera: the odometry is of 'base_link'")
    for words in ("the images are of 'optical'", "tf has no frame", "set camera_pose"):
        bench.nodes[-1].wait_log(words)

    def told() -> dict[str, str]:
        statuses = [status for message in found for status in message.status]
        return {one.key: one.value for one in statuses[-1].values} if statuses else {}

    key = "odometry: no pose, camera's place unknown"
    client.wait(lambda: told().get(key) == "1")
    assert told()["odometry: frames"] == "base_link in odom"
    assert told()["odometry: topic"] == "/odometry"


def test_fixed_scale_multiplies_depth_and_a_scene_cut_resets_the_stream(bench: Bench) -> None:
    client = bench.start(metric_source="fixed", metric_scale=1.0, scene_cut_threshold=0.3)
    one, other = (picture for picture in frames(2, 72, 96, seed=1))
    client.result(client.send(one))
    client.reset()
    plain = depth_of(client.result(client.send(one)))
    after_one = depth_of(client.result(client.send(one)))
    client.wait(lambda: bench.resets[-1:] == ["reset service"])

    assert client.set_parameter("metric_scale", 2.5).successful
    fresh = depth_of(client.result(client.send(other)))
    client.wait(lambda: bench.resets[-1] == "scene cut")
    client.reset()
    np.testing.assert_array_equal(depth_of(client.result(client.send(other))), fresh)
    client.reset()
    np.testing.assert_allclose(
        depth_of(client.result(client.send(one))), plain * np.float32(2.5), rtol=1e-6
    )
    client.wait(lambda: bench.scales[-1] == 2.5)
    assert client.set_parameter("scene_cut_threshold", 0.0).successful
    count = len(bench.resets)
    client.result(client.send(other))
    client.result(client.send(one))
    assert len(bench.resets) == count
    assert not np.array_equal(after_one, plain, equal_nan=True)  # the state matters at all


def test_saved_state_survives_the_node_and_goes_on_bit_for_bit(
    bench: Bench, tmp_path: Path
) -> None:
    path = tmp_path / "state.safetensors"
    client = bench.start(state_file=str(path), max_gap=1e5)
    refused = call(client, "load_state")
    assert not refused.success
    assert "No such file" in refused.message
    pictures = frames(6, seed=3)
    client.reset()
    for picture in pictures[:3]:
        client.result(client.send(picture))
    saved = call(client, "save_state")
    assert saved.success, saved.message
    expected = [depth_of(client.result(client.send(picture))) for picture in pictures[3:]]
    old = path.read_bytes()
    assert client.set_parameter("state_file", str(tmp_path / "no" / "file")).successful
    assert "No such file" in call(client, "save_state").message
    assert client.set_parameter("state_file", "").successful
    assert "state_file is empty" in call(client, "save_state").message
    bench.end(signal.SIGKILL)

    client = bench.start(state_file=str(path), max_gap=1e5)
    assert path.read_bytes() == old
    loaded = call(client, "load_state")
    assert loaded.success, loaded.message
    found = [depth_of(client.result(client.send(picture))) for picture in pictures[3:]]
    for one, two in zip(expected, found, strict=True):
        np.testing.assert_array_equal(one, two)

    path.write_bytes(old[:-100])
    damaged = call(client, "load_state")
    assert not damaged.success
    assert "damaged" in damaged.message
    path.write_bytes(old)
    client.result(client.send(frames(1, 40, 60)[0]))
    other_size = call(client, "load_state")
    assert not other_size.success
    assert "images of 48 x 36 pixels, the camera's have 60 x 40" in other_size.message
    assert client.set_parameter("stabilize", False).successful
    client.result(client.send(pictures[0]))
    other_setting = call(client, "load_state")
    assert not other_setting.success
    assert "saved with stabilize = True" in other_setting.message
