"""The real node with a recipe's parameter file, in this process, and a camera that feeds it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import yaml
from sensor_msgs.msg import CameraInfo

from dyfn_ros.messages.camera_info import camera_info_message
from dyfn_ros.node.node import StreamDepthNode
from tests.support.node_here import running_node
from tests.support.probe import Probe, stamp_of, stamped
from tests.support.recipe_scene import METRES, SIZE, camera_matrix
from tests.support.ros_graph import DEADLINE, image_message, own_domain

ROOT = Path(__file__).resolve().parents[2]
RECIPES = ROOT / "config/recipes"
OPTICAL_FRAME = "camera_optical"
STEP = 200_000_000  # nanoseconds between the stamps of two frames
# A made stream has no odometry: its metres are known. Its pictures are smooth and come again.
MADE = MappingProxyType(
    {
        "metric_source": "fixed",
        "metric_scale": METRES,
        "blank_contrast": 0.0,
        "frozen_after": 0.0,
    }
)


def parameters_of(file: Path, node: str) -> dict[str, Any]:
    """Of one node of a parameter file; its name may have wildcards before it."""
    content = yaml.safe_load(file.read_text(encoding="utf-8"))
    (found,) = [one for name, one in content.items() if name.rsplit("/", 1)[-1] == node]
    values: dict[str, Any] = found["ros__parameters"]
    return values


class RecipeStream:
    """A node that runs a recipe, and what a camera and its listeners do."""

    def __init__(self, node: StreamDepthNode, probe: Probe, image: str, info: str) -> None:
        self.node, self.probe = node, probe
        self._image, self._info = image, info
        self.stamp = 0  # of the newest frame, nanoseconds

    def info(self) -> CameraInfo:
        """Of the made camera."""
        return camera_info_message(None, camera_matrix(), *SIZE)

    def frame(self, picture: np.ndarray, kinds: Mapping[str, type]) -> dict[str, Any]:
        """Send a picture until everything comes back, all of one stamp; -> it, by topic."""
        for topic, kind in kinds.items():
            if topic not in self.probe.received:
                self.probe.listen(topic, kind)
        deadline = self.probe.node.get_clock().now().nanoseconds + int(DEADLINE * 1e9)
        while self.probe.node.get_clock().now().nanoseconds < deadline:
            self.stamp += STEP
            self.probe.publish(self._info, stamped(self.info(), self.stamp, OPTICAL_FRAME))
            message = stamped(image_message(picture), self.stamp, OPTICAL_FRAME)
            self.probe.publish(self._image, message)
            self.probe.spin_until(lambda: len(self._answer(kinds)) == len(kinds), 0.3)
            if len(answer := self._answer(kinds)) == len(kinds):
                return answer
        raise AssertionError(f"no frame came back on {list(kinds)}")

    def _answer(self, kinds: Mapping[str, type]) -> dict[str, Any]:
        """What has come with the newest stamp."""
        received = self.probe.received
        return {
            topic: message
            for topic in kinds
            for message in received[topic]
            if stamp_of(message) == self.stamp
        }


@contextmanager
def recipe_stream(
    file: Path,
    image: str = "/camera/image_raw",
    info: str = "/camera/camera_info",
    **parameters: Any,
) -> Iterator[RecipeStream]:
    """file: of the node's parameters; those given here, and MADE, come before it."""
    line = ["--params-file", str(file), "-r", f"image:={image}", "-r", f"camera_info:={info}"]
    for name, value in {**MADE, **parameters}.items():
        line += ["-p", f"{name}:={str(value).lower() if isinstance(value, bool) else value}"]
    with own_domain() as domain, running_node(domain, line) as node:
        probe = Probe(domain)
        try:
            yield RecipeStream(node, probe, image, info)
        finally:
            probe.close()
