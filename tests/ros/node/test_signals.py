"""A signal ends the node with code 0, at whatever moment it comes."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image

from dyfn_ros.node.end_request import BOUND
from tests.support.probe import Probe, stamped
from tests.support.ros_graph import (
    DEADLINE,
    NodeProcess,
    frames,
    image_message,
    own_domain,
    tiny_node,
)

pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="looks for the signal mask in /proc"
)
INTERRUPT, TERMINATE = signal.SIGINT, signal.SIGTERM
SLACK = 20.0  # seconds that a busy machine may take beyond BOUND


@pytest.fixture(scope="module")
def domain() -> Iterator[dict[str, str]]:
    with own_domain() as environment:
        yield environment


def ends_well(node: NodeProcess, signals: list[signal.Signals]) -> None:
    start = time.monotonic()
    for number in signals:
        if node.process.poll() is None:
            node.process.send_signal(number)
            time.sleep(0.01)
    assert node.end(signals[-1]) == 0, node.log
    assert time.monotonic() - start < BOUND + SLACK, node.log
    for word in ("Traceback", "terminate called", "Fatal Python error", "not ended"):
        assert word not in node.log, node.log


# Where the start is, by a library that it has loaded or a line that it has logged.
IMPORTS, TORCH, DDS, LOADED = "", "libtorch_cpu", "librmw_fastrtps", "log"
MOMENTS = [
    (IMPORTS, 0.0),
    (IMPORTS, 0.2),
    (TORCH, 0.0),
    (DDS, 0.0),
    (DDS, 0.05),
    (DDS, 0.15),
    (LOADED, 0.0),
    (LOADED, 0.1),
    (LOADED, 0.5),
]
SIGNALS = ([INTERRUPT], [TERMINATE], [INTERRUPT, INTERRUPT], [TERMINATE, INTERRUPT])


def wait_stage(node: NodeProcess, stage: str) -> None:
    node.wait_listening()
    if stage == LOADED:
        node.wait_log("tiny on cpu")
    maps = Path(f"/proc/{node.process.pid}/maps")
    deadline = time.monotonic() + DEADLINE
    while stage in (TORCH, DDS) and stage not in maps.read_text():
        assert time.monotonic() < deadline, node.log
        time.sleep(0.005)


def shared_memory() -> set[str]:
    """Of the middleware, on this machine."""
    return {path.name for path in Path("/dev/shm").glob("*fastrtps_*")}


def test_an_ended_node_leaves_no_shared_memory_behind(
    domain: dict[str, str], tmp_path: Path
) -> None:
    """A process that is only stopped keeps some 70 MB of /dev/shm for ever."""
    before = shared_memory()
    node = tiny_node(domain, tmp_path)
    node.wait_log("tiny on cpu")
    made = shared_memory() - before
    ends_well(node, [INTERRUPT])
    assert made
    assert not made & shared_memory()


@pytest.mark.parametrize(("stage", "delay"), MOMENTS)
def test_a_signal_at_any_moment_of_the_start(
    domain: dict[str, str], tmp_path: Path, stage: str, delay: float
) -> None:
    node = tiny_node(domain, tmp_path)
    wait_stage(node, stage)
    time.sleep(delay)
    ends_well(node, SIGNALS[MOMENTS.index((stage, delay)) % len(SIGNALS)])


@pytest.mark.slow
def test_many_nodes_interrupted_at_once_at_many_moments(
    domain: dict[str, str], tmp_path: Path
) -> None:
    """Six at a time, so that threads are preempted where they usually are not."""
    for turn, (stage, delay) in enumerate(MOMENTS):
        nodes = []
        for index in range(6):
            folder = tmp_path / f"{turn}-{index}"
            folder.mkdir()
            nodes.append(tiny_node(domain, folder, autostart=index % 2 == 0 or stage == LOADED))
        for index, node in enumerate(nodes):
            wait_stage(node, stage)
            time.sleep(delay)
            ends_well(node, SIGNALS[(turn + index) % len(SIGNALS)])


@pytest.mark.parametrize("number", [INTERRUPT, TERMINATE])
def test_a_model_that_is_loading_is_not_waited_for(
    domain: dict[str, str], tmp_path: Path, number: signal.Signals
) -> None:
    node = tiny_node(domain, tmp_path, model="endless")
    node.wait_log("loading for ever")
    ends_well(node, [number])


def test_the_summary_reaches_rosout(domain: dict[str, str], tmp_path: Path) -> None:
    node = tiny_node(domain, tmp_path, drop_frames=False)
    probe = Probe(domain)
    try:
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        lines = probe.listen("/rosout", Log, latched)
        depths = probe.listen("depth/image", Image)

        def one_more() -> bool:
            probe.publish("/image", stamped(image_message(frames(1)[0]), time.time_ns()))
            probe.spin_until(lambda: bool(depths), 1.0)
            return bool(depths)

        probe.wait(one_more)
        probe.wait(lambda: any("metres" in line.msg for line in lines))  # /rosout is connected
        ends_well(node, [INTERRUPT, INTERRUPT])
        probe.wait(lambda: any("frames received" in line.msg for line in lines), 20.0)
        assert "Failed to publish" not in node.log
    finally:
        probe.close()


STUCK = """
import threading
from dyfn_ros.node import end_request
end_request.BOUND = 0.5
end = end_request.EndRequest()
end.open()
print("stuck", flush=True)
threading.Event().wait()
"""


def test_what_never_ends_by_itself_is_left() -> None:
    """The owner is asked and does nothing: the process ends all the same."""
    with subprocess.Popen(
        [sys.executable, "-c", STUCK], stdout=-1, stderr=-1, text=True
    ) as process:
        assert process.stdout.readline() == "stuck\n"
        process.send_signal(INTERRUPT)
        assert process.wait(DEADLINE) == 0
        assert "not ended 0.5 s after the signal" in process.stderr.read()
