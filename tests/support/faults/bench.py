"""The real node with a model that is right by construction, and a client that sees everything."""

from __future__ import annotations

import array
import gc
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CompressedImage, Image
from torch import Tensor

from dyfn_core.models import load_model
from dyfn_core.models.base import GeometryModel, Latent
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_ros.messages.images import decode_depth
from dyfn_ros.node.camera import Camera
from dyfn_ros.node.log_throttle import Throttle
from dyfn_ros.node.node import StreamDepthNode
from tests.support.faults.measurements import measurement
from tests.support.node_here import running_node
from tests.support.pinhole import PinholeModel
from tests.support.probe import Probe, stamp_of, stamped
from tests.support.ros_graph import image_message

SIZE = (48, 64)
KNOWN = "known"  # name of the model whose right depth is known
FRAME = "optical"  # frame_id of the pictures
FAILING = (1, 2, 3)  # a first pixel of this colour makes inference raise
PATIENCE = 20.0  # seconds that anything may take on a busy machine
RESEND = 5.0  # seconds after which a picture without an answer is followed by another one
LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "FATAL"}
OF_DIAGNOSTICS = {b"\0": "OK", b"\1": "WARN", b"\2": "ERROR", b"\3": "STALE"}

RAW, PACKED = "raw", "packed"
CAMERAS: dict[str, dict[str, Any]] = {RAW: {}, PACKED: {"image_transport": "compressed"}}
MEASURED = {  # cameras beside a sensor, and the type of its messages
    "cloud": "PointCloud2",
    "scan": "LaserScan",
    "sonar": "Range",
    "dense": "Image",
}
for _name, _type in MEASURED.items():
    CAMERAS[_name] = {
        "metric_source": "reference",
        "reference_type": _type,
        "calibration_seconds": 0.25,
        "calibration_points": 3,
        "after_reset": "withhold",
        "max_gap": 0.0,  # while another camera's faults are done
    }
METRES = 2.0  # in one unit of the model, as the sensors see it


class FaultyPinhole(PinholeModel):
    """Depth is red + 0.5, exactly, so that wrong metres are seen."""

    def encode(self, image: Tensor, num_tokens: int | None = None) -> Latent:
        if tuple((image[0, :, 0, 0] * 255).round().int().tolist()) == FAILING:
            raise RuntimeError("the picture that must fail")
        return super().encode(image, num_tokens)


def scene(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """H x W x 3 uint8 of red blocks: for every seed another scene for FaultyPinhole."""
    height, width = size
    coarse = np.random.default_rng(seed).integers(20, 236, (height // 4 + 2, width // 4 + 2))
    image = np.zeros((height, width, 3), np.uint8)
    # The middle is inside a block.
    image[..., 0] = coarse.repeat(4, 0).repeat(4, 1)[2 : height + 2, 2 : width + 2]
    return image


def true_depth(image: np.ndarray) -> np.ndarray:
    """What the node must say of such a scene."""
    return np.asarray(image[..., 0] / 255 + 0.5)


def raw_image(
    data: np.ndarray | bytes, width: int, height: int, encoding: str = "rgb8", step: int = 0
) -> Image:
    """Whether it makes sense or not. step: 0 is what such rows have."""
    content = bytes(data) if isinstance(data, bytes) else data.tobytes()
    message = Image(height=height, width=width, encoding=encoding)
    message.step = step or len(content) // max(height, 1)
    message.data = array.array("B", content)
    return message


def packed(data: bytes, layout: str = "png") -> CompressedImage:
    message = CompressedImage(format=layout)
    message.data = array.array("B", data)
    return message


def png(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", image[..., ::-1])[1])


@dataclass(frozen=True)
class Recovery:
    """frames: sent until the depth was right again, the last one too. seconds: until then."""

    frames: int
    seconds: float


class Bench:
    """Sends to the node, and keeps what it says: log, diagnostics, answers, depth."""

    def __init__(
        self,
        node: StreamDepthNode,
        probe: Probe,
        cameras: Sequence[str],
        domain: dict[str, str],
    ) -> None:
        self.node, self.probe, self.domain = node, probe, domain
        self.said: list[str] = []  # "WARN text", "diagnostics ERROR text", "answer text"
        self.now = 1_000 * 10**9  # stamp of the last picture, nanoseconds
        self._count = 0
        for camera in cameras:
            probe.listen(f"{camera}/depth/image", Image)
        kept = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        subscribe = probe.node.create_subscription
        subscribe(Log, "/rosout", self._log, kept)
        subscribe(DiagnosticArray, "/diagnostics", self._diagnostics, 10)

    def _log(self, line: Log) -> None:
        self.said.append(f"{LEVELS[line.level]} {line.msg}")

    def _diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            level = OF_DIAGNOSTICS[status.level]
            self.said.append(f"diagnostics {level} {status.name}: {status.message}")

    def ask(self, kind: Any, name: str, request: Any) -> Any:
        """A service of the node. -> its answer; a reason in it is kept."""
        answer = self.probe.call(kind, name, request)
        for one in getattr(answer, "results", [getattr(answer, "result", answer)]):
            text = getattr(one, "reason", "") or getattr(one, "message", "")
            if text:
                self.said.append(f"answer {text}")
        return answer

    def set(self, name: str, value: Any) -> bool:
        """-> whether it was taken."""
        message = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        (result,) = self.ask(SetParameters, "set_parameters", request).results
        return bool(result.successful)

    def wait_said(self, pattern: str, since: int) -> str:
        """What matches in a line, of those after the first `since`."""

        def found() -> str:
            matches = (re.search(pattern, line) for line in self.said[since:])
            return next((match.group() for match in matches if match), "")

        try:
            return self.probe.wait(found, PATIENCE)
        except AssertionError:
            lines = "\n".join(dict.fromkeys(self.said[since:]))
            raise AssertionError(f"no {pattern!r} in:\n{lines}") from None

    # Pictures.

    def step(self, seconds: float = 0.1) -> int:
        """-> the stamp of the next picture."""
        self.now += round(seconds * 1e9)
        return self.now

    def fresh(self, size: tuple[int, int] = SIZE) -> np.ndarray:
        """A scene that was not there before."""
        self._count += 1
        return scene(self._count, size)

    def send(self, camera: str, message: Any, stamp: int | None = None) -> int:
        """-> the stamp."""
        stamp = self.step() if stamp is None else stamp
        topic = f"/{camera}/image" + "/compressed" * isinstance(message, CompressedImage)
        self.probe.publish(topic, stamped(message, stamp, FRAME))
        return stamp

    def send_scene(self, camera: str, image: np.ndarray, stamp: int | None = None) -> int:
        """In the form that the camera has."""
        form = packed(png(image)) if camera == PACKED else image_message(image)
        return self.send(camera, form, stamp)

    def depths(self, camera: str, stamp: int) -> list[np.ndarray]:
        """What came of a picture so far."""
        heard = self.probe.received[f"{camera}/depth/image"]
        return [decode_depth(one) for one in heard if stamp_of(one) == stamp]

    def work(self, camera: str, message: Any, stamp: int | None = None) -> np.ndarray | None:
        """Send a picture and wait until the node is done with it. -> its depth, if there is one."""
        stamp = self.step() if stamp is None else stamp
        lost, known = self.lost(camera), len(self.depths(camera, stamp))
        self.send(camera, message, stamp)
        self.probe.wait(partial(self.came, camera, stamp, known, lost), PATIENCE)
        found = self.depths(camera, stamp)
        return found[-1] if len(found) > known else None

    def came(self, camera: str, stamp: int, known: int, lost: int) -> bool:
        """Whether there is more depth of a picture than was known, or one more picture is lost."""
        return len(self.depths(camera, stamp)) > known or self.lost(camera) > lost

    def camera(self, name: str) -> Camera:
        """The node's own."""
        (found,) = (one for one in self.node._cameras if one.name == name)
        return found

    def lost(self, camera: str) -> int:
        """Pictures that the node could not use, or failed on."""
        counts = self.camera(camera).statistics.counts
        return counts["bad"] + counts["failed"]

    def right(self, depth: np.ndarray, image: np.ndarray) -> bool:
        """Whether the depth is that of the scene, nearly everywhere."""
        if depth.shape != image.shape[:2]:
            return False
        good = np.abs(depth / true_depth(image) - 1) < 0.01
        return bool(good.mean() > 0.9)

    def measure(self, camera: str, image: np.ndarray, stamp: int) -> None:
        """Let the sensor beside the camera measure such a scene, if there is one."""
        if camera in MEASURED:
            message = measurement(MEASURED[camera], METRES * true_depth(image))
            self.probe.publish(f"/{camera}/reference", stamped(message, stamp, ""))

    def recover(self, camera: str) -> Recovery:
        """Send scenes one at a time until one has the right depth."""
        start = time.monotonic()
        for count in range(1, 100):
            image, stamp = self.fresh(), self.step()
            known = len(self.depths(camera, stamp))
            self.measure(camera, image, stamp)
            self.send_scene(camera, image, stamp)
            came = partial(self.came, camera, stamp, known, self.lost(camera))
            self.probe.spin_until(came, RESEND)
            unit = METRES if camera in MEASURED else 1.0
            if any(self.right(depth / unit, image) for depth in self.depths(camera, stamp)[known:]):
                return Recovery(count, time.monotonic() - start)
            assert time.monotonic() - start < PATIENCE, f"no good depth after {count} pictures"
        raise AssertionError("no good depth after 100 pictures")


@contextmanager
def faulty_bench(
    domain: dict[str, str], cameras: Sequence[str] = (RAW, PACKED), **parameters: Any
) -> Iterator[Bench]:
    """A node with such cameras and the client, which have seen each other."""
    gc.collect()  # rcl keeps a node while Python does, and the next of its name has no /rosout
    values: dict[str, Any] = {
        "model": KNOWN,
        "cameras": f"[{', '.join(cameras)}]",
        "device": "cpu",
        "threads": 1,
        "scene_cut_threshold": 0.0,  # the scenes have nothing in common
        "diagnostics_period": 0.05,
    }
    for camera in cameras:
        own = CAMERAS.get(camera, {})
        values.update({f"{camera}.{name}": value for name, value in own.items()})
    values.update(parameters)
    arguments = [part for name, value in values.items() for part in ("-p", f"{name}:={value}")]
    probe = Probe(domain)
    try:
        with running_node(domain, arguments, _load, counted=True) as node:
            _say_everything(node)
            bench = Bench(node, probe, cameras, domain)
            for camera in cameras:
                bench.recover(camera)
            yield bench
    finally:
        probe.close()


def _load(name: str, device: str) -> GeometryModel:
    if name != KNOWN:
        return load_model(name, device)
    model = FaultyPinhole()
    # The identity, whatever it remembers: the right depth stays known.
    model.stabilizer = build_dyfn(3, DyFNConfig(hidden=4, form="residual"))
    return model.eval()


def _say_everything(node: StreamDepthNode) -> None:
    """Faults follow each other faster than on a robot: nothing is kept back for a while."""
    node._throttle = node._reset_throttle = Throttle(period=0.0)
