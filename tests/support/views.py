"""What the files for RViz and Foxglove show: the topics, and the types that they take."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

CONFIG = Path(__file__).resolve().parents[2] / "config"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
DISPLAYS = {
    "Image": IMAGE,
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "Pose": "geometry_msgs/msg/PoseStamped",
}


@dataclass(frozen=True)
class Shown:
    """One topic.

    fixed: whether its colours have a fixed range of depth; None: it is no depth. reliability: of
    RViz's subscription, in its words.
    """

    topic: str
    kind: str
    fixed: bool | None = None
    reliability: str = ""


def image_kind(topic: str) -> str:
    return COMPRESSED if topic.endswith("/compressed") else IMAGE


def of_rviz(path: Path) -> Iterator[Shown]:
    for display in yaml.safe_load(path.read_text())["Visualization Manager"]["Displays"]:
        kind = DISPLAYS[display["Class"].removeprefix("rviz_default_plugins/")]
        topic = display["Topic"]
        name = topic["Value"]
        assert (topic["History Policy"], topic["Durability Policy"]) == ("Keep Last", "Volatile")
        fixed = None
        if kind == IMAGE and name.endswith("depth/image"):
            fixed = not display["Normalize Range"] and display["Max Value"] > display["Min Value"]
        kind = image_kind(name) if kind == IMAGE else kind
        yield Shown(name, kind, fixed, topic["Reliability Policy"])


def of_foxglove(path: Path) -> Iterator[Shown]:
    layout = json.loads(path.read_text())
    assert panels_of(layout["layout"]) == [*layout["configById"]]
    for name, panel in layout["configById"].items():
        kind = name.partition("!")[0]
        if kind == "Image":
            mode = panel["imageMode"]
            topic = mode["imageTopic"]
            fixed = mode.get("maxValue", 0) > mode.get("minValue", 0)
            yield Shown(topic, image_kind(topic), fixed if topic.endswith("depth/image") else None)
            if "calibrationTopic" in mode:
                yield Shown(mode["calibrationTopic"], "sensor_msgs/msg/CameraInfo")
        elif kind == "3D":
            for topic in panel["topics"]:
                last = topic.rsplit("/", 1)[1]
                kinds = {"points": "PointCloud2", "image": "Image", "pose": "Pose"}
                yield Shown(topic, DISPLAYS[kinds[last]])
        elif kind == "Plot":
            for line in panel["paths"]:
                topic, field = line["value"].rsplit(".", 1)
                assert field == "data"
                yield Shown(topic, "std_msgs/msg/Float64")
        else:
            assert kind == "DiagnosticSummary"
            yield Shown(panel["topicToRender"], DIAGNOSTICS)


def panels_of(layout: Any) -> list[str]:
    """In the order in which the layout has them."""
    if isinstance(layout, str):
        return [layout]
    return [*panels_of(layout["first"]), *panels_of(layout["second"])]
