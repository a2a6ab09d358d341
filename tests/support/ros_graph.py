"""A node in another process and a client in this one, on a DDS domain of their own.

Everything waits for an event with a deadline; nothing sleeps and hopes.
"""

from __future__ import annotations

import array
import fcntl
import itertools
import os
import re
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import rclpy
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

DEADLINE = 240.0  # a busy machine imports torch slowly
NODE = "/stream_depth"
RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
_OPENED = itertools.count()


@contextmanager
def own_domain() -> Iterator[dict[str, str]]:
    """Environment of a domain that no other test on this machine uses while this is open.

    Nor did this process lately: who has ended stays known there for a while.
    """
    first = os.getpid() + next(_OPENED)
    for number in (1 + (first + offset) % 99 for offset in range(99)):
        path = Path(tempfile.gettempdir()) / f"dyfn-test-domain-{number}.lock"
        with path.open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield {"ROS_DOMAIN_ID": str(number), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
            return
    raise RuntimeError("all DDS domains are taken")


class NodeProcess:
    """A running command; its output goes to a file that can be waited on."""

    def __init__(self, command: list[str], environment: dict[str, str], folder: Path) -> None:
        self.log_path = folder / "node.log"
        with self.log_path.open("wb") as log:
            self.process = subprocess.Popen(
                command,
                env={
                    **os.environ,
                    "ROS_LOG_DIR": str(folder),
                    "OMP_NUM_THREADS": "1",
                    "PYTHONFAULTHANDLER": "1",
                    **environment,
                },
                cwd=folder,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    @property
    def log(self) -> str:
        return self.log_path.read_text()

    def wait_log(self, pattern: str) -> str:
        """The first match in the output, once it is there."""
        deadline = time.monotonic() + DEADLINE
        while not (match := re.search(pattern, self.log)):
            assert self.process.poll() is None, f"the node ended:\n{self.log}"
            assert time.monotonic() < deadline, f"no {pattern!r} in:\n{self.log}"
            select.select([], [], [], 0.02)
        return match.group()

    def end(self, number: int = signal.SIGINT) -> int:
        """Send a signal; -> exit code."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        try:
            return self.process.wait(DEADLINE)
        except subprocess.TimeoutExpired as error:
            self.process.send_signal(signal.SIGABRT)  # the fault handler says where it stands
            self.process.wait(10)
            raise AssertionError(f"{error}; the node's log:\n{self.log}") from error

    def wait_listening(self) -> None:
        """Until the process has blocked SIGINT for itself: from then on it knows what one means."""
        status = Path(f"/proc/{self.process.pid}/status")
        deadline = time.monotonic() + DEADLINE
        while True:
            assert self.process.poll() is None, f"the node ended:\n{self.log}"
            assert time.monotonic() < deadline, "the node blocks no signal"
            blocked = re.search(r"SigBlk:\s*(\w+)", status.read_text())
            if blocked and int(blocked.group(1), 16) & 1 << (signal.SIGINT - 1):
                return
            time.sleep(0.01)

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def tiny_node(
    environment: dict[str, str],
    folder: Path,
    remap: Mapping[str, str] = MappingProxyType({}),
    **parameters: Any,
) -> NodeProcess:
    """stream_depth with the tiny model and one inference thread."""
    command = [sys.executable, "-m", "tests.support.tiny_node", "--ros-args"]
    values = {"model": "tiny", "device": "cpu", "threads": 1, "scene_cut_threshold": 0.0}
    values.update(parameters)  # the pictures of the tests have nothing in common
    for name, value in values.items():
        command += ["-p", f"{name}:={str(value).lower() if isinstance(value, bool) else value}"]
    for name, target in remap.items():
        command += ["-r", f"{name}:={target}"]
    return NodeProcess(command, environment, folder)


class Client:
    """Publishes images and collects everything that the node publishes, by stamp."""

    def __init__(
        self,
        environment: dict[str, str],
        *,
        image_type: type = Image,
        image_qos: QoSProfile = RELIABLE,
        subscribe: bool = True,
        image: str = "image",
    ) -> None:
        os.environ.update(environment)
        self.context = Context()
        rclpy.init(context=self.context, domain_id=int(environment["ROS_DOMAIN_ID"]))
        self.node = rclpy.create_node("client", context=self.context, enable_rosout=False)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        topic = image if image_type is Image else f"{image}/compressed"
        self.images = self.node.create_publisher(image_type, topic, image_qos)
        self.infos = self.node.create_publisher(CameraInfo, "camera_info", RELIABLE)
        self.received: dict[int, dict[str, Any]] = defaultdict(dict)
        self.order: list[int] = []
        self.subscriptions: list[Any] = []
        if subscribe:
            self.subscribe()
        # Last: endpoints are announced in order, so who answers these has seen the others.
        self.reset_client = self.node.create_client(Trigger, f"{NODE}/reset")
        self.parameter_client = self.node.create_client(SetParameters, f"{NODE}/set_parameters")
        self._stamp = 0
        self.wait(lambda: self.images.get_subscription_count() == 1)
        self.wait(lambda: self.infos.get_subscription_count() == 1)

    def subscribe(self) -> None:
        kinds = {"depth/image": Image, "depth/camera_info": CameraInfo, "points": PointCloud2}
        for topic, kind in kinds.items():
            self.subscriptions.append(
                self.node.create_subscription(
                    kind, f"{NODE}/{topic}", lambda m, t=topic: self._take(t, m), RELIABLE
                )
            )

    def _take(self, topic: str, message: Any) -> None:
        stamp = message.header.stamp.sec
        self.received[stamp][topic] = message
        if topic == "depth/image":
            self.order.append(stamp)

    def wait(self, condition: Callable[[], bool], seconds: float = DEADLINE) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, f"waited {seconds} s in vain"
            self.executor.spin_once(timeout_sec=0.02)

    def spin_until(self, condition: Callable[[], bool], seconds: float) -> None:
        """Until the condition is true, or so long."""
        deadline = time.monotonic() + seconds
        while not condition() and time.monotonic() < deadline:
            self.executor.spin_once(timeout_sec=0.02)

    def header(self) -> Header:
        self._stamp += 1
        header = Header(frame_id="optical")
        header.stamp.sec, header.stamp.nanosec = self._stamp, 500_000_000 + self._stamp
        return header

    def send(self, rgb: np.ndarray) -> int:
        """Publish an image; -> its stamp, the key of what comes back."""
        return self.send_message(image_message(rgb))

    def send_message(self, message: Image | CompressedImage) -> int:
        message.header = self.header()
        self.images.publish(message)
        return message.header.stamp.sec

    def send_info(self, info: CameraInfo) -> None:
        info.header = Header(frame_id="optical")
        self.infos.publish(info)

    def result(self, stamp: int) -> dict[str, Any]:
        """All three outputs of a frame, once they are there."""
        self.wait(lambda: len(self.received[stamp]) == 3)
        return self.received[stamp]

    def prime(self) -> None:
        """Until node and client see each other on every topic, and no frame is under way.

        Frames are sent until one comes back whole; then the last one is waited for.
        """
        self.settle()  # a node that is still loading would get a queue full of them
        stamps: list[int] = []
        deadline = time.monotonic() + DEADLINE
        while not any(len(self.received[s]) == 3 for s in stamps):
            assert time.monotonic() < deadline, "no frame came back"
            stamps.append(self.send(frames(1)[0]))
            self.spin_until(lambda: len(self.received[stamps[-1]]) == 3, 0.3)
        last = self.send(frames(1)[0])
        self.result(last)

    def reset(self) -> Trigger.Response:
        return self._call(self.reset_client, Trigger.Request())

    def set_parameter(self, name: str, value: Any) -> Any:
        message: ParameterMessage = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        return self._call(self.parameter_client, request).results[0]

    def settle(self) -> None:
        """Until the node has seen our topics and taken what was sent before."""
        assert self.set_parameter("publish_points", True).successful

    def _call(self, client: Any, request: Any) -> Any:
        """Asks again now and then: DDS loses an answer to a client whom the node knows half."""
        self.wait(client.service_is_ready)
        futures: list[Any] = []

        def answered() -> bool:
            return any(future.done() for future in futures)

        deadline = time.monotonic() + DEADLINE
        while not answered():
            assert time.monotonic() < deadline, f"no answer from {client.srv_name}"
            futures.append(client.call_async(request))
            self.spin_until(answered, 10.0)
        return next(future for future in futures if future.done()).result()

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


def image_message(rgb: np.ndarray, encoding: str = "rgb8") -> Image:
    height, width = rgb.shape[:2]
    message = Image(height=height, width=width, encoding=encoding, step=rgb[0].nbytes)
    message.data = array.array("B", rgb.tobytes())
    return message


def frames(count: int, height: int = 36, width: int = 48, seed: int = 0) -> list[np.ndarray]:
    """Smooth random pictures that drift, H x W x 3 uint8."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(40, 216, (count, height // 4 + 1, width // 4 + 1, 3))
    return [c.repeat(4, 0).repeat(4, 1)[:height, :width].astype(np.uint8) for c in coarse]


def camera_info(height: int = 36, width: int = 48, focal: float = 40.0) -> CameraInfo:
    cx, cy = width / 2 + 1.25, height / 2 - 2.5
    return CameraInfo(
        height=height,
        width=width,
        k=[focal, 0.0, cx, 0.0, focal * 1.1, cy, 0.0, 0.0, 1.0],
        p=[focal, 0.0, cx, 0.0, 0.0, focal * 1.1, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        distortion_model="plumb_bob",
        d=[0.0] * 5,
    )


class Gate:
    """Two named pipes that hold a BLOCKING picture inside the model until `open`."""

    def __init__(self, folder: Path) -> None:
        self.environment = {}
        self._pipes = {}
        for name in ("TINY_ENTERED", "TINY_GO"):
            path = folder / name
            os.mkfifo(path)
            self.environment[name] = str(path)
            self._pipes[name] = os.open(path, os.O_RDWR | os.O_NONBLOCK)

    def entered(self, seconds: float = 0.1) -> bool:
        ready, _, _ = select.select([self._pipes["TINY_ENTERED"]], [], [], seconds)
        return bool(ready and os.read(self._pipes["TINY_ENTERED"], 1))

    def wait_entered(self) -> None:
        assert self.entered(DEADLINE), "inference did not start"

    def open(self) -> None:
        os.write(self._pipes["TINY_GO"], b".")

    def close(self) -> None:
        for pipe in self._pipes.values():
            os.close(pipe)
