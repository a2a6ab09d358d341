"""Processes that die, stand still, or ask and go away; and nodes whose own process is ended."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from tests.support.faults.bench import PATIENCE, RAW, Bench, faulty_bench
from tests.support.faults.fault import Fault
from tests.support.faults.pictures import RIGHT, outcome
from tests.support.ros_graph import image_message, tiny_node

OTHERS = """
import sys, time, rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger
rclpy.init()
node = rclpy.create_node("other")
kind = sys.argv[1]
if kind == "camera":
    image = Image(height=48, width=64, encoding="rgb8", step=192, data=bytes(range(96)) * 96)
    publisher = node.create_publisher(Image, "/raw/image", 10)
    while not publisher.get_subscription_count():
        time.sleep(0.01)
    print("ready", flush=True)
    while True:
        publisher.publish(image)
        time.sleep(0.02)
if kind == "viewer":
    node.create_subscription(Image, "/stream_depth/raw/depth/image", lambda message: None, 10)
    while not node.count_publishers("/stream_depth/raw/depth/image"):
        time.sleep(0.01)
    print("ready", flush=True)
    rclpy.spin(node)
client = node.create_client(Trigger, "/stream_depth/raw/reset")
client.wait_for_service()
futures = [client.call_async(Trigger.Request()) for _ in range(300)]
print("ready", flush=True)
rclpy.spin(node)
"""


@contextmanager
def process_bench(domain: dict[str, str]) -> Iterator[Bench]:
    with faulty_bench(domain, (RAW,), frozen_after=0.0) as bench:
        yield bench


@contextmanager
def other(bench: Bench, kind: str) -> Iterator[subprocess.Popen[str]]:
    """A process that has found the node."""
    with subprocess.Popen([sys.executable, "-c", OTHERS, kind], stdout=-1, text=True) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "ready\n"
            bench.probe.spin_until(lambda: False, 0.2)
            yield process
        finally:
            process.kill()


def killed(kind: str, times: int = 1) -> Callable[[Bench], str]:
    def do(bench: Bench) -> str:
        for _ in range(times):
            with other(bench, kind) as process:
                process.send_signal(signal.SIGKILL)
                process.wait()
        return "the node goes on"

    return do


def stopped_viewer(bench: Bench) -> str:
    """A reliable subscriber that takes nothing any more; depth comes as fast as without."""
    with other(bench, "viewer") as process:
        process.send_signal(signal.SIGSTOP)
        for _ in range(50):
            image = bench.fresh()
            assert outcome(bench, bench.work(RAW, image_message(image)), image) == RIGHT
    return f"50 of 50 pictures, {RIGHT}"


def mixed(bench: Bench) -> str:
    """A best-effort publisher beside the reliable one: both are heard."""
    quiet = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = bench.probe.node.create_publisher(Image, "/raw/image", quiet)
    bench.probe.wait(lambda: not bench.camera(RAW).reliable, PATIENCE)
    image = bench.fresh()
    assert outcome(bench, bench.work(RAW, image_message(image)), image) == RIGHT
    bench.probe.node.destroy_publisher(publisher)
    bench.probe.wait(lambda: bench.camera(RAW).reliable, PATIENCE)
    return RIGHT


def stranger(bench: Bench) -> str:
    """A subscriber with a QoS that the node's depth does not have."""
    deadline = rclpy.duration.Duration(seconds=0.001)
    node = bench.probe.node
    one = node.create_subscription(
        Image,
        "/stream_depth/raw/depth/image",
        lambda m: None,
        QoSProfile(depth=1, deadline=deadline),
    )
    image = bench.fresh()
    assert outcome(bench, bench.work(RAW, image_message(image)), image) == RIGHT
    since = len(bench.said)
    bench.wait_said("diagnostics WARN stream_depth: .*incompatible QoS", since)
    node.destroy_subscription(one)
    return f"{RIGHT} for all others"


def twin(bench: Bench) -> str:
    since = len(bench.said)
    one = rclpy.create_node("stream_depth", context=bench.probe.context)
    bench.wait_said("diagnostics WARN stream_depth: .*1 other node is called", since)
    one.destroy_node()
    return "the node goes on"


def ended(number: signal.Signals, times: int, moment: str) -> Callable[[Bench], str]:
    """Of another node, in a process of its own. moment: a line of its log, or "" for the start."""

    def do(bench: Bench) -> str:
        with tempfile.TemporaryDirectory() as folder:
            node = tiny_node(bench.domain, Path(folder), {"__ns": "/another"})
            if moment:
                node.wait_log(moment)
            else:
                node.wait_listening()
            for _ in range(times):
                if node.process.poll() is None:
                    node.process.send_signal(number)
            code = node.end(number)
            assert code == (-number if number == signal.SIGKILL else 0), node.log
            for word in ("Traceback", "terminate called"):
                assert word not in node.log
            return f"ended with {code}"

    return do


def refused_start(name: str, value: Any) -> Callable[[Bench], str]:
    """A node with such a parameter does not start."""

    def do(bench: Bench) -> str:
        with tempfile.TemporaryDirectory() as folder:
            node = tiny_node(bench.domain, Path(folder), {"__ns": "/another"}, **{name: value})
            code = node.process.wait(240)
            bench.said.append(f"answer {node.log.strip().splitlines()[-1]}")
            assert code == 1
            assert "Traceback" not in node.log
        return "ended with 1"

    return do


FAULTS = (
    Fault("a camera's process, killed 2 times", killed("camera", 2), within=3),
    Fault("a viewer's process, killed", killed("viewer")),
    Fault("a viewer's process, stopped (SIGSTOP)", stopped_viewer),
    Fault("a client, killed with 300 open requests", killed("client"), within=3),
    Fault("a best-effort publisher beside a reliable one", mixed),
    Fault("a subscriber with another QoS", stranger, ("WARN .*incompatible QoS .*",)),
    Fault("another node of the same name", twin, ("WARN 1 other node is called /stream_depth",)),
    Fault("SIGINT, twice, while the node starts", ended(signal.SIGINT, 2, "")),
    Fault("SIGTERM while it runs", ended(signal.SIGTERM, 1, "waiting for images")),
    Fault("kill -9 while it runs", ended(signal.SIGKILL, 1, "waiting for images")),
    Fault(
        "a start with a parameter out of its range",
        refused_start("max_gap", -1.0),
        ("answer stream_depth: Invalid parameter value .*max_gap.*",),
        True,
    ),
)
