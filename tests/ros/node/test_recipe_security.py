"""The policy for SROS2 allows what the node does, and no more."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from types import ModuleType
from xml.etree import ElementTree

import pytest
from geometry_msgs.msg import TransformStamped

from dyfn_ros.node.node import StreamDepthNode
from tests.support.node_here import SUCCESS, made_node
from tests.support.pinhole import PinholeModel
from tests.support.recipe_stream import RECIPES, ROOT
from tests.support.ros_graph import own_domain

POLICY = RECIPES / "stream_depth_policy.xml"
PAGE = ROOT / "docs/recipes/security.md"
# What may be configured, so that every input of the policy is there in one of them.
CONFIGURATIONS = {
    "as it is": [],
    "JPEG and odometry": [
        *("-p", "image_transport:=compressed", "-p", "metric_source:=odometry"),
        *("-p", "use_sim_time:=true"),
    ],
    "reference": ["-p", "metric_source:=reference"],
}
Does = frozenset[tuple[str, str]]  # ("publish", "/topic"), ...


def allowed() -> Does:
    """By the policy; names as sros2 resolves them."""
    (context,) = ElementTree.parse(POLICY).getroot().iter("context")
    assert context.get("path") == "/stream_depth"
    (profile,) = context.iter("profile")
    namespace = profile.get("ns", "").rstrip("/")
    found = []
    for group in profile:
        ((what, verdict),) = group.attrib.items()
        assert verdict == "ALLOW"
        for entry in group:
            name = str(entry.text)
            assert group.tag == f"{entry.tag}s"
            found.append((what, name if name.startswith("/") else f"{namespace}/{name}"))
    assert len(found) == len(set(found)), "a line is there twice"
    return frozenset(found)


def remappings() -> list[str]:
    """Those that the policy says it is made for."""
    comment = re.findall(r"-r \S+:=\S+", POLICY.read_text(encoding="utf-8"))
    return [word for pair in comment for word in pair.split()]


def done(node: StreamDepthNode) -> Does:
    own = node.get_name(), node.get_namespace()
    endpoints = {
        "publish": node.get_publisher_names_and_types_by_node(*own),
        "subscribe": node.get_subscriber_names_and_types_by_node(*own),
        "reply": node.get_service_names_and_types_by_node(*own),
        "request": node.get_client_names_and_types_by_node(*own),
    }
    return frozenset((what, name) for what, found in endpoints.items() for name, _ in found)


@pytest.fixture(scope="module")
def does() -> Iterator[dict[str, Does]]:
    """By configuration; the model has normals."""
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PinholeModel, "has_normals", True, raising=False)
        if find_spec("tf2_msgs") is None:  # no wheels have it; any type shows the topics
            messages = ModuleType("tf2_msgs.msg")
            messages.TFMessage = TransformStamped  # type: ignore[attr-defined]
            patch.setitem(sys.modules, "tf2_msgs", ModuleType("tf2_msgs"))
            patch.setitem(sys.modules, "tf2_msgs.msg", messages)
        for name, parameters in CONFIGURATIONS.items():
            line = remappings() + parameters
            with own_domain() as domain, made_node(domain, line) as node:
                assert node.trigger_configure() == SUCCESS
                found[name] = done(node)
        yield found


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_what_the_node_does_is_allowed(does: dict[str, Does], name: str) -> None:
    assert does[name] - allowed() == frozenset()


def test_nothing_is_allowed_that_the_node_never_does(does: dict[str, Does]) -> None:
    assert allowed() - frozenset().union(*does.values()) == frozenset()


def test_the_node_calls_nobody_and_the_policy_lets_it_call_nobody(does: dict[str, Does]) -> None:
    assert "request" not in {what for what, _ in frozenset().union(*does.values()) | allowed()}
    services = {name for what, name in allowed() if what == "reply"}
    assert {"/stream_depth/calibrate", "/stream_depth/reset"} <= services
    assert ("publish", "/stream_depth/valid_ratio") in allowed()


def test_the_page_names_the_policy_and_its_enclave() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert f"config/recipes/{POLICY.name}" in text
    assert "--enclave /stream_depth" in text
    for pair in re.findall(r"\S+:=\S+", POLICY.read_text(encoding="utf-8")):
        assert pair in text
