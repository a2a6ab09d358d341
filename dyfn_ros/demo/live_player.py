"""Plays frames to a live node over DDS and takes what it publishes, without losing any."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_srvs.srv import Trigger

from dyfn_ros.demo.node_process import LiveError, NodeProcess
from dyfn_ros.demo.odometry import RecordedOdometry
from dyfn_ros.messages.clouds import cloud_points
from dyfn_ros.messages.images import decode_depth
from dyfn_ros.recordings.open import RecordedFrame
from dyfn_ros.recordings.typestore import COMPRESSED_IMAGE, TYPES

OUTPUTS = {"depth/image": Image, "depth/camera_info": CameraInfo, "points": PointCloud2}
START_PATIENCE = 180.0  # seconds for imports and loading the model, on a busy machine
FRAME_PATIENCE = 60.0
PRIME_INTERVAL, SLOWER = 0.5, 1.4
ASK_INTERVAL = 10.0  # DDS loses an answer to a client whose endpoints are not all known yet
RELIABLE = QoSProfile(depth=20, reliability=ReliabilityPolicy.RELIABLE)
POSES = QoSProfile(depth=200, reliability=ReliabilityPolicy.RELIABLE)


@dataclass(frozen=True)
class LiveResult:
    """What came back for one frame.

    depth: H x W float32, NaN invalid. cloud: H x W of messages.CLOUD_DTYPE.
    latency: seconds from publishing the image to receiving the depth.
    """

    frame: RecordedFrame
    depth: np.ndarray
    cloud: np.ndarray
    latency: float


class LivePlayer:
    """Publishes a frame, waits for all of its outputs, publishes the next.

    process: the node, watched while waiting. image_kind: message type of the frames' sources.
    namespace: the node's; "" for none. odometry: published beside the images, for a node whose
    metric_source it is.
    A context manager. Raises NodeExitError when the node ends, LiveError when it does not answer.
    """

    def __init__(
        self,
        process: NodeProcess,
        image_kind: str,
        domain: int,
        namespace: str = "",
        odometry: RecordedOdometry | None = None,
    ) -> None:
        self._process = process
        self._name = f"{namespace}/stream_depth"
        self._changed = threading.Condition()
        self._arrived: dict[int, dict[str, tuple[Any, float]]] = {}
        self._primes = 0
        self._context = Context()
        rclpy.init(
            context=self._context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,  # Ctrl-C must raise in this process
        )
        self._node = rclpy.create_node("dyfn_player", context=self._context, namespace=namespace)
        compressed = image_kind == COMPRESSED_IMAGE
        kind, topic = (CompressedImage, "image/compressed") if compressed else (Image, "image")
        self._images = self._node.create_publisher(kind, topic, RELIABLE)
        self._infos = self._node.create_publisher(CameraInfo, "camera_info", RELIABLE)
        self._odometry, self._poses = odometry, []
        if odometry is not None:
            self._poses = [self._node.create_publisher(Odometry, "odometry", POSES)]
        self._subscriptions = [self._subscribe(name) for name in OUTPUTS]
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, name="ros", daemon=True)
        self._thread.start()

    def __enter__(self) -> LivePlayer:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._thread.join(5)
        self._node.destroy_node()
        self._context.try_shutdown()

    def prime(self, frame: RecordedFrame) -> None:
        """Send copies of a frame until one comes back whole: then every connection stands.

        They are stamped 1, 2, 3 ... nanoseconds; reset() afterwards.
        """
        deadline, interval = time.monotonic() + START_PATIENCE, PRIME_INTERVAL
        while time.monotonic() < deadline:
            self._primes += 1
            message = frame.source.message()
            message.header.stamp.sec, message.header.stamp.nanosec = 0, self._primes
            data = bytes(TYPES.serialize_cdr(message, frame.source.kind))
            self._publish(frame, data, self._primes)
            whole = self._wait(lambda: self._complete(self._primes), interval)
            interval *= SLOWER  # or a node that is slower than this would never catch up
            if whole and all(poses.get_subscription_count() for poses in self._poses):
                with self._changed:
                    self._arrived.clear()
                return
        raise LiveError(f"{self._name}: no frame came back within {START_PATIENCE:.0f} s")

    def reset(self, stabilize: bool) -> None:
        """Choose DyFN on or off, then reset the stream by the reset service."""
        wanted = Parameter("stabilize", value=stabilize).to_parameter_msg()
        request = SetParameters.Request(parameters=[wanted])
        for result in self._call(SetParameters, "set_parameters", request).results:
            if not result.successful:
                raise LiveError(f"{self._name}: parameter stabilize: {result.reason}")
        response = self._call(Trigger, "reset", Trigger.Request())
        if not response.success:
            raise LiveError(f"{self._name}/reset: {response.message}")

    def play(self, frames: Iterable[RecordedFrame]) -> Iterator[LiveResult]:
        """Results in order; the caller's work on one overlaps the node's work on the next."""
        ready: LiveResult | None = None
        feed = None if self._odometry is None else self._odometry.feed()
        for frame in frames:
            for data in () if feed is None else feed.until(frame.stamp_ns):
                self._poses[0].publish(data)
            sent = self._publish(frame, frame.source.data, frame.stamp_ns)
            if ready is not None:
                yield ready
            ready = self._receive(frame, sent)
        if ready is not None:
            yield ready

    def _subscribe(self, name: str) -> Any:
        def take(message: Any) -> None:
            now = time.perf_counter()
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            with self._changed:
                if stamp in self._arrived:
                    self._arrived[stamp][name] = (message, now)
                    self._changed.notify_all()

        return self._node.create_subscription(OUTPUTS[name], f"{self._name}/{name}", take, RELIABLE)

    def _publish(self, frame: RecordedFrame, data: bytes, stamp_ns: int) -> float:
        with self._changed:
            self._arrived[stamp_ns] = {}
        if frame.info is not None:
            self._infos.publish(frame.info.data)
        sent = time.perf_counter()
        self._images.publish(data)
        return sent

    def _receive(self, frame: RecordedFrame, sent: float) -> LiveResult:
        if not self._wait(lambda: self._complete(frame.stamp_ns), FRAME_PATIENCE):
            with self._changed:
                missing = sorted(set(OUTPUTS) - set(self._arrived[frame.stamp_ns]))
            raise LiveError(
                f"{self._name}: frame {frame.index}: nothing on {missing} "
                f"within {FRAME_PATIENCE:.0f} s"
            )
        with self._changed:
            outputs = self._arrived.pop(frame.stamp_ns)
        depth, arrived = outputs["depth/image"]
        cloud, _ = outputs["points"]
        return LiveResult(frame, decode_depth(depth), cloud_points(cloud), arrived - sent)

    def _complete(self, stamp_ns: int) -> bool:
        return len(self._arrived[stamp_ns]) == len(OUTPUTS)

    def _wait(self, condition: Callable[[], bool], patience: float) -> bool:
        """Whether the condition came true in time; raises NodeExitError if the node ends."""
        deadline = time.monotonic() + patience
        while True:
            with self._changed:
                if self._changed.wait_for(condition, min(0.2, patience)):
                    return True
            self._process.check()
            if time.monotonic() > deadline:
                return False

    def _call(self, kind: Any, name: str, request: Any) -> Any:
        """For requests that may be done twice."""
        client = self._node.create_client(kind, f"{self._name}/{name}")
        if not self._wait(client.service_is_ready, FRAME_PATIENCE):
            raise LiveError(f"{self._name}/{name}: no such service")
        for _ in range(round(FRAME_PATIENCE / ASK_INTERVAL)):
            future = client.call_async(request)
            if self._wait(future.done, ASK_INTERVAL):
                self._node.destroy_client(client)
                return future.result()
        raise LiveError(f"{self._name}/{name}: no answer within {FRAME_PATIENCE:.0f} s")
