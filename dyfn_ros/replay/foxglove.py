"""A layout of Foxglove for output.mcap."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from dyfn_core.files import write_text

ACCUMULATED = 3600  # seconds that a cloud stays


def write_layout(path: Path, image_topic: str, *, raw: bool, depth: tuple[float, float]) -> None:
    """Write a layout: input, depth and truth, the clouds in the world, the scale over time.

    Args:
        path: The file; it appears only when it is complete.
        image_topic: The input's topic.
        raw: Whether depth and clouds are as predicted; else coloured depth of `depth` is there.
        depth: Nearest and farthest depth of the colours.
    """
    near, far = depth
    pictures: dict[str, dict[str, Any]] = {"Image!input": {"imageTopic": image_topic}}
    if raw:
        colours = {"colorMode": "colormap", "colorMap": "turbo", "minValue": near, "maxValue": far}
        pictures["Image!depth"] = {"imageTopic": "/stream_depth/depth/image", **colours}
    else:
        pictures["Image!depth"] = {"imageTopic": "/stream_depth/depth/colored/compressed"}
        truth = "/stream_depth/depth/colored_ground_truth/compressed"
        pictures["Image!truth"] = {"imageTopic": truth}
    panels: dict[str, Any] = {name: {"imageMode": mode} for name, mode in pictures.items()}
    if not raw:
        panels["Image!depth"]["foxglovePanelTitle"] = f"depth, {near:.2g} to {far:.2g}"
        panels["Image!truth"]["foxglovePanelTitle"] = f"ground truth, {near:.2g} to {far:.2g}"
    clouds = {
        "visible": True,
        "colorField": "rgb",
        "colorMode": "rgb",
        "pointSize": 2,
        "decayTime": 0 if raw else ACCUMULATED,
    }
    panels["3D!world"] = {
        "followMode": "follow-none",
        "followTf": "world",
        "topics": {"/stream_depth/points": clouds, "/stream_depth/pose": {"visible": True}},
    }
    lines = ("scale", "median_depth", "abs_rel")
    panels["Plot!scale"] = {
        "paths": [
            {
                "value": f"/stream_depth/{name}.data",
                "enabled": True,
                "timestampMethod": "receiveTime",
            }
            for name in lines
        ],
        "showLegend": True,
    }
    layout = {
        "direction": "row",
        "splitPercentage": 35,
        "first": _column([*pictures]),
        "second": _split("column", "3D!world", "Plot!scale", 70),
    }
    found = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": layout,
    }
    write_text(path, json.dumps(found, indent=2) + "\n")


def _column(names: list[str]) -> Any:
    """Panels below each other, all of one height."""
    if len(names) == 1:
        return names[0]
    return _split("column", names[0], _column(names[1:]), 100 / len(names))


def _split(direction: str, first: Any, second: Any, share: float) -> dict[str, Any]:
    return {
        "direction": direction,
        "splitPercentage": share,
        "first": first,
        "second": second,
    }
