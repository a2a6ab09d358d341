"""A node whose camera is covered or frozen: no metres, and an ERROR while it lasts."""

from __future__ import annotations

import array
from collections.abc import Iterator

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Float64

from dyfn_core.stream.picture_check import BLANK, FROZEN
from dyfn_ros.messages.images import decode_depth
from tests.support.ros_graph import NODE, Client, frames, image_message, own_domain, tiny_node


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with own_domain() as domain:
        node = tiny_node(
            domain,
            tmp_path_factory.mktemp("node"),
            drop_frames=False,
            metric_source="fixed",
            metric_scale=2.0,
            diagnostics_period=0.1,
            frozen_after=0.5,
            max_gap=0.0,
        )
        client = Client(domain)
        client.prime()
        yield client
        client.close()
        assert node.end() == 0, node.log
        assert f"/image: {BLANK}; no depth while it lasts" in node.log
        assert f"/image: {FROZEN}; no depth while it lasts" in node.log
        assert "/image: the pictures show a scene again" in node.log


def constant(level: int) -> Image:
    return image_message(np.full_like(frames(1)[0], level))


def of_floats(value: float) -> Image:
    height, width = frames(1)[0].shape[:2]
    data = np.full((height, width), value, np.float32)
    message = Image(height=height, width=width, encoding="32FC1", step=4 * width)
    message.data = array.array("B", data.tobytes())
    return message


UNUSABLE = {
    "black": (lambda: [constant(0)], BLANK),
    "white": (lambda: [constant(255)], BLANK),
    "grey": (lambda: [constant(117)], BLANK),
    "all NaN": (lambda: [of_floats(float("nan"))], BLANK),
    "constant floats": (lambda: [of_floats(0.3)], BLANK),
    "frozen": (lambda: [image_message(frames(1, seed=7)[0]) for _ in range(10)], FROZEN),
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_no_metres_and_an_error_while_it_lasts(client: Client, name: str) -> None:
    make, reason = UNUSABLE[name]
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    heard: list[dict[str, DiagnosticStatus]] = []
    statuses: list[DiagnosticStatus] = []
    scales: list[float] = []
    subscribe = client.node.create_subscription
    listening = [
        subscribe(
            DiagnosticArray,
            "/diagnostics",
            lambda m: heard.append({one.name: one for one in m.status}),
            10,
        ),
        subscribe(DiagnosticStatus, f"{NODE}/scale/status", statuses.append, latched),
        subscribe(Float64, f"{NODE}/scale", lambda m: scales.append(m.data), latched),
    ]

    def depth(message: Image) -> np.ndarray:
        return decode_depth(client.result(client.send_message(message))["depth/image"])

    def level() -> bytes:
        return heard[-1]["stream_depth: camera"].level if heard else b""

    for message in make():
        last = depth(message)
    assert np.isnan(last).all()
    error = DiagnosticStatus.ERROR
    client.wait(lambda: level() == error and bool(statuses) and statuses[-1].level == error)
    assert reason in heard[-1]["stream_depth: camera"].message
    assert reason in statuses[-1].message
    assert np.isnan(scales[-1])
    assert np.isfinite(depth(image_message(frames(1, seed=3)[0]))).any()
    client.wait(lambda: level() != error and statuses[-1].level == DiagnosticStatus.OK)
    assert scales[-1] == 2.0
    for one in listening:
        client.node.destroy_subscription(one)
