"""Throughput of the node with 1, 2 and 4 cameras, as ratios to one camera in the same run.

    python benchmarks/cameras.py [--model dyfn-mini] [--cameras 1 2 4] [--seconds 20]
        [--size 320x240] [--threads 2] [--out cameras.json]

Each camera has one raw frame under way, the next is sent when its depth has come; depth and cloud
are subscribed. Batched, and one after the other. Subscriptions are reliable: a camera whose frame
is lost would stand still, and its rate would measure DDS instead of the node.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from dyfn_ros.demo.node_process import NodeProcess
from dyfn_ros.node.environment import prepare_environment

PATIENCE = 180.0


class Feeder:
    """Keeps one frame of each camera under way and counts what comes back.

    everything: subscribe to all outputs, not to depth and cloud alone.
    """

    def __init__(
        self,
        cameras: list[str],
        images: list[np.ndarray],
        namespace: str,
        everything: bool = False,
    ) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
        from std_srvs.srv import Trigger

        self.count = dict.fromkeys(cameras, 0)
        self.latency: list[float] = []
        self.others = 0  # messages of the other outputs
        self._sent: dict[str, float] = {}
        self._messages = [self._message(image) for image in images]
        self._other = [self._message(np.ascontiguousarray(image[::2, ::2])) for image in images]
        self._node = rclpy.create_node("feeder", namespace=namespace)
        qos = QoSProfile(depth=10)
        self._publishers = {
            camera: self._node.create_publisher(Image, f"{camera}/image", qos) for camera in cameras
        }
        for camera in cameras:
            prefix = f"{namespace}/stream_depth/{camera}"
            self._node.create_subscription(
                Image, f"{prefix}/depth/image", lambda _, c=camera: self._take(c), qos
            )
            others = {"points": PointCloud2}
            if everything:
                others["depth/camera_info"] = CameraInfo
                others["depth/image/compressedDepth"] = CompressedImage
                others["depth/colored"] = Image
            for topic, kind in others.items():
                self._node.create_subscription(kind, f"{prefix}/{topic}", self._count_other, qos)
        self._request = Trigger.Request()
        self._reset = self._node.create_client(Trigger, f"{namespace}/stream_depth/reset")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)

    def _count_other(self, _: Any) -> None:
        self.others += 1

    @staticmethod
    def _message(rgb: np.ndarray) -> Any:
        import array

        from sensor_msgs.msg import Image

        height, width = rgb.shape[:2]
        message = Image(height=height, width=width, encoding="rgb8", step=3 * width)
        message.header.frame_id = "camera"
        message.data = array.array("B", rgb.tobytes())
        return message

    def _take(self, camera: str) -> None:
        self.count[camera] += 1
        self.latency.append(time.perf_counter() - self._sent.pop(camera, time.perf_counter()))
        self._send(camera)

    def _send(self, camera: str) -> None:
        message = self._messages[self.count[camera] % len(self._messages)]
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._sent[camera] = time.perf_counter()
        self._publishers[camera].publish(message)

    def resend(self, camera: str) -> None:
        """After a frame that was dropped on purpose."""
        self._send(camera)

    def prime(self, process: NodeProcess) -> None:
        """Until every camera's depth comes back."""
        deadline = time.monotonic() + PATIENCE
        while not all(self.count.values()):
            process.check()
            if time.monotonic() > deadline:
                raise TimeoutError(f"no depth of some camera within {PATIENCE:.0f} s: {self.count}")
            for camera, count in self.count.items():
                if not count:
                    self._send(camera)
            until = time.monotonic() + 1.0
            while time.monotonic() < until and not all(self.count.values()):
                self._executor.spin_once(timeout_sec=0.1)

    def run(self, seconds: float) -> dict[str, float]:
        """Frames a second over all cameras, of the slowest camera, and latencies in ms."""
        before = dict(self.count)
        self.latency.clear()
        start = time.perf_counter()
        while time.perf_counter() - start < seconds:
            self._executor.spin_once(timeout_sec=0.1)
        elapsed = time.perf_counter() - start
        done = [self.count[camera] - before[camera] for camera in before]
        median, most = np.quantile(self.latency, [0.5, 0.99]) * 1e3
        return {
            "frames_per_second": sum(done) / elapsed,
            "slowest_camera": min(done) / elapsed,
            "latency_p50_ms": float(median),
            "latency_p99_ms": float(most),
        }

    def spin(self) -> None:
        """Take what has come."""
        self._executor.spin_once(timeout_sec=0.1)

    def resize(self) -> None:
        """The frames from now on have half, or again double, the size."""
        self._messages, self._other = self._other, self._messages

    def reset(self) -> None:
        """Call the node's reset service, without waiting for its answer."""
        self._reset.call_async(self._request)

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()


def measure(options: argparse.Namespace, count: int, batch: bool) -> dict[str, float]:
    """One node with `count` cameras."""
    import rclpy

    cameras = [f"camera{i}" for i in range(count)]
    width, height = (int(part) for part in options.size.split("x"))
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(4)]
    parameters = {
        "model": options.model,
        "cameras": f"[{', '.join(cameras)}]",
        "threads": options.threads,
        "batch": batch,
        "reliability": "reliable",
        "scene_cut_threshold": 0.0,
    }
    namespace = f"/cameras_{os.getpid()}_{count}_{int(batch)}"
    with (
        tempfile.TemporaryDirectory() as folder,
        NodeProcess(Path(folder) / "node.log", parameters, namespace) as process,
    ):
        rclpy.init()
        feeder = Feeder(cameras, images, namespace)
        try:
            feeder.prime(process)
            feeder.run(options.seconds / 4)
            return feeder.run(options.seconds)
        finally:
            feeder.close()
            rclpy.try_shutdown()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="dyfn-mini")
    parser.add_argument("--cameras", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--size", default="320x240")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    prepare_environment()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    results = {}
    for batch in (True, False):
        for count in options.cameras:
            name = f"{count} camera{'s' * (count > 1)}, {'batched' if batch else 'one by one'}"
            results[name] = measure(options, count, batch)
    baseline = next(iter(results.values()))["frames_per_second"]
    for name, row in results.items():
        row["ratio"] = row["frames_per_second"] / baseline
        print(
            f"{name:24} {row['frames_per_second']:7.2f} frames/s  ratio {row['ratio']:.2f}  "
            f"slowest camera {row['slowest_camera']:6.2f}/s  "
            f"p50 {row['latency_p50_ms']:6.0f} ms  p99 {row['latency_p99_ms']:6.0f} ms"
        )
    if options.out:
        options.out.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
