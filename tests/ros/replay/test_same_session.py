"""One recording to the node over DDS and to dyfn-replay: each feature of the stream, byte for byte.

The models are small and real. What is sent to the node is written to a recording as it is sent.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from mcap.reader import make_reader
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_srvs.srv import Trigger

from dyfn_core.geometry.rigid import between, inverse, quaternion_rotation, rigid
from dyfn_core.models.base import GeometryModel
from dyfn_core.stream.picture_check import BLANK, FROZEN
from dyfn_ros.messages.images import decode_depth
from dyfn_ros.recordings.typestore import IMAGE, TF, TYPES
from dyfn_ros.recordings.writer import RecordingWriter
from dyfn_ros.replay.cli import main
from dyfn_ros.replay.jobs import ALL
from tests.support.odometry import MOUNT, odometry, pose_text, tf_message, tf_topic, transform
from tests.support.pinhole import FOV_X, PinholeModel
from tests.support.points import cloud_message
from tests.support.ros_graph import (
    NODE,
    RELIABLE,
    Client,
    camera_info,
    frames,
    image_message,
    own_domain,
    tiny_node,
)
from tests.support.textured_plane import CAMERA, SIZE, plane_view, texture, walk
from tests.support.tiny_model import load_tiny

TOPICS = {
    **{Image: "image", CameraInfo: "camera_info", PointCloud2: "cloud"},
    **{Odometry: "odom", TransformStamped: "tf_static"},
}
KINDS = {kind: f"sensor_msgs/msg/{kind.__name__}" for kind in TOPICS}
KINDS |= {Odometry: "nav_msgs/msg/Odometry", TransformStamped: TF}
LISTENED = {PointCloud2: "reference", Odometry: "odometry", TransformStamped: "/tf_static"}
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
Message = Image | PointCloud2 | Odometry | TransformStamped


def load(name: str, device: str) -> GeometryModel:
    return PinholeModel().eval() if name == "pinhole" else load_tiny(name, device)


def stamped(message: Any, second: int, rest: float = 0.0) -> Any:
    message.header.frame_id = "optical"
    message.header.stamp.sec, message.header.stamp.nanosec = second, round(rest * 1e9)
    return message


def images(seconds: list[int], pictures: list[np.ndarray]) -> list[Message]:
    pairs = zip(seconds, pictures, strict=True)
    return [stamped(image_message(picture), second) for second, picture in pairs]


def record(path: Path, info: CameraInfo, messages: list[Message]) -> Path:
    with RecordingWriter(path, overwrite=True) as writer:
        for number, message in enumerate([info, *messages]):
            if isinstance(message, TransformStamped):
                data = bytes(TYPES.serialize_cdr(tf_message(message), TF))
            else:
                data = bytes(serialize_message(message))
            writer.write_cdr(f"/{TOPICS[type(message)]}", KINDS[type(message)], data, number)
    return path


@dataclass
class Session:
    """A node with options, and dyfn-replay with the same."""

    folder: Path
    client: Client
    options: dict[str, Any]
    info: CameraInfo = field(default_factory=camera_info)
    publishers: dict[type, Any] = field(default_factory=dict)

    def call(self, name: str) -> str:
        response = self.client._call(
            self.client.node.create_client(Trigger, f"{NODE}/{name}"), Trigger.Request()
        )
        assert response.success, response.message
        return str(response.message)

    def live(self, messages: list[Message]) -> list[bytes]:
        """The node's depth of every image; each is sent when the one before is back."""
        self.client.received.clear()
        self.client.send_info(self.info)
        found = []
        for message in messages:
            if isinstance(message, Image):
                self.client.settle()  # what was measured before has arrived
                self.client.images.publish(message)
                result = self.client.result(message.header.stamp.sec)
                found.append(decode_depth(result["depth/image"]).tobytes())
            else:
                kind, static = type(message), isinstance(message, TransformStamped)
                if isinstance(message, TransformStamped):
                    message = tf_topic(message)
                self.publisher(kind, type(message), static).publish(message)
        return found

    def publisher(self, kind: type, sent: type, static: bool) -> Any:
        if kind not in self.publishers:
            qos = LATCHED if static else RELIABLE
            made = self.client.node.create_publisher(sent, LISTENED[kind], qos)
            self.publishers[kind] = made
            self.client.wait(lambda: made.get_subscription_count() == 1)
            self.call("reset")  # by a new client: who answers it has seen the publisher before it
        return self.publishers[kind]

    def replay(self, messages: list[Message], *more: str) -> tuple[list[bytes], dict[str, Any]]:
        """dyfn-replay's depth of every image, and its metrics.json."""
        recording, out = record(self.folder / "sent.mcap", self.info, messages), self.folder / "out"
        command = [str(recording), "--out", str(out), "--write", "raw", "--device", "cpu"]
        command += ["--threads", "1", "--depth-topic", "none", *more]
        for name, value in {"model": "tiny", "scene_cut_threshold": 0.0, **self.options}.items():
            flag = f"--{name.replace('_', '-')}"
            command += [flag] if value is True else [flag, str(value)]
        assert main(command, load) == ALL
        with (out / "output.mcap").open("rb") as file:
            found = make_reader(file).iter_messages(
                "/stream_depth/depth/image", log_time_order=False
            )
            depths = [
                decode_depth(TYPES.deserialize_cdr(message.data, IMAGE)).tobytes()
                for _, _, message in found
            ]
        return depths, json.loads((out / "metrics.json").read_text())


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Callable[..., Session]]:
    with own_domain() as domain:
        open_: list[Any] = []

        def start(state_file: str = "", **options: Any) -> Session:
            parameters = {**options, **({"state_file": state_file} if state_file else {})}
            node = tiny_node(domain, tmp_path, drop_frames=False, **parameters)
            open_.append(node.kill)
            client = Client(domain)
            open_.append(client.close)
            client.prime()
            client.reset()
            return Session(tmp_path, client, options)

        yield start
        for close in reversed(open_):
            close()


def finite(depth: bytes) -> bool:
    return bool(np.isfinite(np.frombuffer(depth, np.float32)).any())


def test_time_rules_and_scene_cuts(session: Callable[..., Session]) -> None:
    bench = session(max_gap=8.0, stamp_tolerance=1.5, scene_cut_threshold=0.5)
    one, other = frames(2, seed=1)
    seconds = [10, 11, 30, 31, 29, 32, 33, 34, 35]
    pictures = [one, one, one, one, one, one, one, other, other]
    sent = images(seconds, pictures)
    sent[6].header.stamp.nanosec = 950_000_000  # the cut is between pictures close in time
    live = bench.live(sent)
    offline, metrics = bench.replay(sent)
    assert live == offline
    assert [line.partition(" (")[0] for line in metrics["reset_log"]] == [
        "at 30.000 s: gap between stamps",
        "at 29.000 s: stamp went back",
        "at 34.000 s: scene cut",
    ]
    assert metrics["resets"] == {
        "gap between stamps": 1,
        "stamp went back": 1,
        "scene cut": 1,
    }
    assert offline[2] == offline[0] == offline[4] != offline[1]


def test_a_fixed_scale(session: Callable[..., Session]) -> None:
    bench = session(metric_source="fixed", metric_scale=2.5)
    sent = images([10, 11, 12], frames(3, seed=2))
    live = bench.live(sent)
    offline, metrics = bench.replay(sent)
    assert live == offline
    assert metrics["metric_scale"]["unit"] == "metres"
    bench.options = {}
    relative, _ = bench.replay(sent)
    scaled = [np.frombuffer(d, np.float32) * np.float32(2.5) for d in relative]
    assert [d.tobytes() for d in scaled] == offline


def test_another_library(
    session: Callable[..., Session], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DYFN_EXPORTS", str(tmp_path / "exports"))
    bench = session(backend="onnxruntime")
    sent = images([10, 11, 12, 13], frames(4, seed=3))
    live = bench.live(sent)
    made = sorted(path.name for path in (tmp_path / "exports").iterdir())
    offline, metrics = bench.replay(sent)
    assert live == offline
    assert metrics["options"]["backend"] == "onnxruntime"
    assert [name.split("-")[1] for name in made] == ["decode", "encode", "stabilize"]
    assert made == sorted(path.name for path in (tmp_path / "exports").iterdir())
    bench.options = {}
    exact, metrics = bench.replay(sent)
    assert metrics["options"]["backend"] == "torch"
    for one, other in zip(exact, offline, strict=True):
        one, other = np.frombuffer(one, np.float32), np.frombuffer(other, np.float32)
        np.testing.assert_allclose(other, one, rtol=1e-4)


def relative(
    bench: Session, seconds: list[int], pictures: list[np.ndarray]
) -> Iterator[np.ndarray]:
    """N x 3 points that the model predicts in each picture, up to scale."""
    measured, bench.options = bench.options, {}
    depths, _ = bench.replay(images(seconds, pictures))
    bench.options = measured
    inverse = np.linalg.inv(np.reshape(bench.info.k, (3, 3)))
    for depth, picture in zip(depths, pictures, strict=True):
        z = np.frombuffer(depth, np.float32).reshape(picture.shape[:2])
        v, u = np.nonzero(np.isfinite(z))
        points = np.stack([u, v, np.ones_like(u)], 1) @ inverse.T * z[v, u, None]
        yield points[:: max(1, len(points) // 60)]


def test_a_reference_topic(session: Callable[..., Session]) -> None:
    """Nothing before the calibration, metres after it, and a stale measurement counts.

    The sensor is placed by tf, and every other measurement comes after its image.
    """
    bench = session(
        metric_source="reference",
        calibration="track",
        calibration_seconds=2.0,
        reference_tolerance=0.4,
        reference_disagreement=3.0,
    )
    seconds = [20, 21, 22, 23, 24, 25]
    pictures = frames(len(seconds), seed=4)
    sensor = rigid(quaternion_rotation(0.8, 0.0, 0.6, 0.0), np.array([0.3, -0.2, 0.1]))
    sent: list[Message] = [transform(sensor, 0, "optical", "lidar")]
    sent += [cloud_message(np.ones((3, 3)), (5, 0), "lidar")]
    pairs = zip(seconds, images(seconds, pictures), relative(bench, seconds, pictures), strict=True)
    for second, image, points in pairs:
        points = (3.0 * points - sensor[:3, 3]) @ sensor[:3, :3]
        cloud = cloud_message(points, (second, 200_000_000), "lidar")
        sent += [image, cloud] if second % 2 else [cloud, image]
    live = bench.live(sent)
    offline, metrics = bench.replay(sent, "--reference-topic", "/cloud")
    assert live == offline
    assert not finite(offline[0]) and finite(offline[-1])
    assert metrics["metric_scale"]["source"] == "reference"
    assert float(metrics["metric_scale"]["scale"]) == pytest.approx(3, rel=0.02)
    assert metrics["recording"]["warnings"]["/cloud: measurements or points not used: stale"] == 1


def test_the_camera_height(session: Callable[..., Session]) -> None:
    """A floor 0.5 units below a level camera that is 1.5 m above it."""
    bench = session(
        model="pinhole",
        metric_source="camera_height",
        camera_height=1.5,
        calibration_points=2,
        calibration_seconds=2.0,
        blank_contrast=0.0,  # a floor and nothing on it
    )
    height, width = 48, 64
    focal = width / 2 / np.tan(np.radians(FOV_X / 2))
    bench.info = CameraInfo(height=height, width=width)
    bench.info.k = [focal, 0.0, (width - 1) / 2, 0.0, focal, (height - 1) / 2, 0.0, 0.0, 1.0]
    bench.info.p = np.insert(np.reshape(bench.info.k, (3, 3)), 3, 0.0, axis=1).reshape(-1)
    rows = np.arange(height) - (height - 1) / 2
    floor = np.zeros((height, width, 3), np.uint8)
    floor[..., 0] = np.round((np.clip(0.5 * focal / np.maximum(rows, 1e-3), 0.5, 1.5) - 0.5) * 255)[
        :, None
    ]
    sent = images([10, 11, 12, 13], [floor] * 4)
    live = bench.live(sent)
    offline, metrics = bench.replay(sent)
    assert live == offline and finite(offline[-1])
    assert float(metrics["metric_scale"]["scale"]) == pytest.approx(3.0, rel=0.1)


def test_a_covered_lens_and_a_frozen_camera(session: Callable[..., Session]) -> None:
    bench = session(metric_source="fixed", metric_scale=2.0, max_gap=0.0)
    black = np.zeros_like(frames(1)[0])
    one, other = frames(2, seed=9)
    pictures = [one, black, black, *[other] * 11, one]
    sent = images(list(range(10, 10 + len(pictures))), pictures)
    live = bench.live(sent)
    offline, metrics = bench.replay(sent)
    assert live == offline
    nothing = [index for index, depth in enumerate(live) if not finite(depth)]
    assert nothing == [1, 2, 12, 13]
    assert metrics["pictures_without_depth"] == {BLANK: 2, FROZEN: 2}
    warned = metrics["recording"]["warnings"]
    assert warned[f"pictures without depth: {BLANK}"] == 2


def plane_walk(bench: Session, count: int) -> tuple[list[Message], list[Message]]:
    """Images along a plane at 1 Hz, and the odometry of the base before and after each of them."""
    focal = SIZE[1] / 2 / np.tan(np.radians(FOV_X / 2))
    camera = np.array([[focal, 0, CAMERA[0, 2]], [0, focal, CAMERA[1, 2]], [0, 0, 1]])
    bench.info = CameraInfo(height=SIZE[0], width=SIZE[1], k=camera.reshape(9))
    bench.info.p = np.insert(camera, 3, 0.0, axis=1).reshape(12)
    poses, whole = walk(count + 2), texture()
    pictures, bodies = [], []
    for index in range(1, count + 1):
        view = plane_view(poses[index], whole, camera)
        picture = np.zeros((*SIZE, 3), np.uint8)
        picture[..., 0] = np.round((view.depth / 3 - 0.5) * 255)
        picture[..., 1] = view.image[..., 1]
        pictures.append(picture)
        for rest in (-0.4, -0.1, 0.2, 0.45):
            near = poses[index + (1 if rest > 0 else -1)]
            pose = between(poses[index], near, abs(rest)) @ inverse(MOUNT)
            bodies.append(odometry(pose, 10 + index + rest))
    return images(list(range(11, 11 + count)), pictures), bodies


def test_scale_memory(session: Callable[..., Session]) -> None:
    bench = session(model="pinhole", scale_memory=True)
    pictures, _ = plane_walk(bench, 8)
    live = bench.live(pictures)
    offline, metrics = bench.replay(pictures)
    assert live == offline
    assert metrics["options"]["scale_memory"] is True


@pytest.mark.parametrize("by_parameter", [False, True])
def test_odometry(session: Callable[..., Session], by_parameter: bool) -> None:
    """Of a base that carries the camera: its place by /tf_static, or by parameter."""
    place = {"camera_pose": pose_text(MOUNT)} if by_parameter else {}
    bench = session(model="pinhole", metric_source="odometry", **place)
    pictures, bodies = plane_walk(bench, 12)
    sent: list[Message] = []
    if not by_parameter:
        sent.append(transform(MOUNT, 0, "base_link", "optical"))
    for index, picture in enumerate(pictures):
        sent += [*bodies[4 * index : 4 * index + 4], picture]
    live = bench.live(sent)
    offline, metrics = bench.replay(sent)
    assert live == offline
    assert metrics["odometry"]["camera's place"] == ("camera_pose" if by_parameter else "tf")
    assert metrics["odometry"]["images with a pose"] == "12"
    assert metrics["metric_scale"]["unit"] == "metres"
    assert float(metrics["metric_scale"]["scale"]) == pytest.approx(3.0, rel=0.1)
    assert not finite(offline[0]) and finite(offline[-1])


def test_a_saved_state(session: Callable[..., Session], tmp_path: Path) -> None:
    """The node saves and a replay goes on from there; a replay saves and the node goes on."""
    pictures = frames(6, seed=3)
    sent = images([10, 11, 12, 13, 14, 15], pictures)
    live_file, offline_file = tmp_path / "live.safetensors", tmp_path / "offline.safetensors"
    bench = session(str(live_file), metric_source="fixed", metric_scale=2.0)
    whole = bench.live(sent)
    bench.client.reset()
    assert bench.live(sent[:3]) == whole[:3]
    bench.call("save_state")
    state = ("--state-file", str(live_file), "--load-state")
    rest, metrics = bench.replay(sent[3:], *state)
    assert rest == whole[3:] and metrics["resets"] == {}
    assert "goes on after 3 frames" in metrics["state"]["loaded"]

    state = ("--state-file", str(offline_file), "--save-state")
    first, metrics = bench.replay(sent[:3], *state)
    assert first == whole[:3] and "saved 3 frames" in metrics["state"]["saved"]
    assert bench.client.set_parameter("state_file", str(offline_file)).successful
    bench.call("load_state")
    assert bench.live(sent[3:]) == whole[3:]
    assert bench.replay(sent[3:])[0] != whole[3:]  # the state matters
