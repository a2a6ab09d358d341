"""Topics that go along when a depth image is remapped."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import rclpy
from rclpy.context import Context

from dyfn_ros.node.topics import DepthNames, NodeTopics
from tests.support.ros_graph import own_domain

IMAGE, INFO = "~/front/depth/image", "~/front/depth/camera_info"


@pytest.fixture(scope="module")
def context() -> Iterator[Context]:
    with own_domain() as environment:
        context = Context()
        rclpy.init(context=context, domain_id=int(environment["ROS_DOMAIN_ID"]))
        yield context
        context.try_shutdown()


@contextmanager
def topics(context: Context, remap: dict[str, str]) -> Iterator[tuple[NodeTopics, list[str]]]:
    arguments = ["--ros-args"]
    for name, target in remap.items():
        arguments += ["-r", f"{name}:={target}"]
    warnings: list[str] = []
    node = rclpy.create_node("n", context=context, namespace="/robot", cli_args=arguments)
    try:
        yield NodeTopics(node, warnings.append), warnings
    finally:
        node.destroy_node()


OWN = "/robot/n/front/depth"


@pytest.mark.parametrize(
    ("remap", "compressed", "info"),
    [
        ({}, f"{OWN}/image/compressedDepth", f"{OWN}/camera_info"),
        ({IMAGE: "/a/depth/image"}, "/a/depth/image/compressedDepth", "/a/depth/camera_info"),
        ({IMAGE: "/front_depth"}, "/front_depth/compressedDepth", "/camera_info"),
        ({IMAGE: "/a/b", INFO: "/c/info"}, "/a/b/compressedDepth", "/c/info"),
        ({INFO: "/c/info"}, f"{OWN}/image/compressedDepth", "/c/info"),
        ({IMAGE: "/a/b", f"{IMAGE}/compressedDepth": "/packed"}, "/packed", "/a/camera_info"),
        ({IMAGE: "depth"}, "/robot/depth/compressedDepth", "/robot/camera_info"),
    ],
)
def test_the_siblings_follow_unless_they_are_remapped_themselves(
    context: Context, remap: dict[str, str], compressed: str, info: str
) -> None:
    with topics(context, remap) as (ports, warnings):
        assert ports.depth_names(IMAGE, INFO, ()) == DepthNames(compressed, info)
    assert not warnings


def test_the_camera_s_own_camera_info_is_not_published_over(context: Context) -> None:
    with topics(context, {IMAGE: "/camera/depth"}) as (ports, warnings):
        found = ports.depth_names(IMAGE, INFO, {"/camera/camera_info"})
    assert found.info == "/camera/depth/camera_info"
    assert "/camera/camera_info is another's" in warnings[0]
