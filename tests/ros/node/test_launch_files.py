"""The launch files: run where ROS launch is installed, else what they would start is looked at."""

from __future__ import annotations

import shutil
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from ament_index_python import get_packages_with_prefixes

from dyfn_ros.node.parameters.table import SPECS
from tests.support.launch_stand_in import ROOT, Process, declared, processes
from tests.support.node_here import SUCCESS, made_node
from tests.support.ros_graph import NodeProcess, own_domain

LAUNCH = ROOT / "launch"
FILES = sorted(LAUNCH.glob("*.launch.py"))
every_file = pytest.mark.parametrize("path", FILES, ids=lambda path: path.name.split(".")[0])


def of_stream_depth(path: Path, **arguments: str) -> Process:
    """The first of its nodes."""
    found = processes(path, **arguments)
    ours = next(one for one in found if one.executable == "stream_depth")
    assert ours.package == "dyfn_ros"
    return ours


@every_file
def test_it_runs_under_ros_launch(path: Path, tmp_path: Path) -> None:
    """The whole command, until the node waits for images; it ends with code 0."""
    if find_spec("launch_ros") is None or shutil.which("ros2") is None:
        pytest.skip("ROS launch is not installed: no Python wheels have launch and launch_ros")
    missing = {one.package for one in processes(path)} - set(get_packages_with_prefixes())
    if missing:
        pytest.skip(f"the ROS packages {sorted(missing)} are not installed")
    with own_domain() as domain:
        node = NodeProcess(["ros2", "launch", str(path)], domain, tmp_path)
        node.wait_log("waiting for images on")
        assert node.end() == 0, node.log


@every_file
def test_every_argument_is_described(path: Path) -> None:
    found = declared(path)
    assert {"image", "camera_info", "model", "params_file", "rviz", "frame"} <= set(found)
    assert all(text.endswith(".") for text in found.values())


@every_file
def test_its_files_are_there_and_its_parameters_are_the_node_s(path: Path) -> None:
    for one in processes(path, rviz="true"):
        names = [*one.files, *(Path(word) for word in one.arguments if word.endswith(".rviz"))]
        for name in names:
            assert name.is_file(), name
            shipped = str(name.parent.relative_to(ROOT))
            assert f'files("{shipped}")' in (ROOT / "setup.py").read_text(encoding="utf-8")
        if one.package == "dyfn_ros":
            assert set(one.values) <= {*SPECS, "use_sim_time"}


@every_file
def test_what_it_starts_subscribes_the_camera(path: Path) -> None:
    """The node runs with the very arguments, configured, on the topics that were asked for."""
    several = "cameras" in declared(path)
    asked = {"image": "shown", "camera_info": "of_it"}
    if not several:
        asked = {name: f"/front/{topic}" for name, topic in asked.items()}
    ours = of_stream_depth(path, **asked)
    with own_domain() as domain, made_node(domain, ours.command_line) as node:
        assert node.trigger_configure() == SUCCESS
        for topic in ("/front/shown", "/front/of_it"):
            assert node.count_subscribers(topic) > 0, topic


def test_one_camera_gets_its_topics_parameters_and_namespace() -> None:
    ours = of_stream_depth(
        LAUNCH / "stream_depth.launch.py",
        image="/cam/image",
        camera_info="/cam/info",
        odometry="/odom",
        namespace="robot",
        model="other",
        autostart="false",
        params_file=str(ROOT / "config/cameras/odometry.yaml"),
    )
    assert ours.values == {"model": "other", "autostart": False}
    with own_domain() as domain, made_node(domain, ours.command_line) as node:
        assert node.get_fully_qualified_name() == "/robot/stream_depth"
        settings = node.settings
        assert (settings.model, settings.autostart) == ("other", False)
        assert settings.metric_source == "odometry"  # of the file
        assert node.trigger_configure() == SUCCESS
        for topic in ("/cam/image", "/cam/info", "/odom"):
            assert node.count_subscribers(topic) > 0, topic
        assert node.count_publishers("/robot/stream_depth/points") == 1


def test_the_parameter_file_holds_where_no_argument_is_given() -> None:
    path = ROOT / "config/cameras/gazebo.yaml"
    (content,) = yaml.safe_load(path.read_text()).values()
    assert content["ros__parameters"]["use_sim_time"] is True
    ours = of_stream_depth(LAUNCH / "stream_depth.launch.py", params_file=str(path))
    with own_domain() as domain, made_node(domain, ours.command_line) as node:
        assert node.get_parameter("use_sim_time").value is True
        assert node.settings.model == "dyfn-mini"
    other = processes(LAUNCH / "stream_depth.launch.py", use_sim_time="true")[0]
    assert other.values == {"use_sim_time": True}


def test_rviz_shows_what_the_launched_node_publishes() -> None:
    """Its relative names are in its namespace, which is the node's."""
    found = processes(
        LAUNCH / "stream_depth.launch.py", image="/cam/image", namespace="robot", rviz="true"
    )
    (rviz,) = [one for one in found if one.executable == "rviz2"]
    assert rviz.namespace == "robot"
    assert rviz.remappings["/camera/image_raw"] == "/cam/image"
    with own_domain() as domain, made_node(domain, found[0].command_line) as node:
        assert node.trigger_configure() == SUCCESS
        names = {name for name, _ in node.get_topic_names_and_types()}
        for shown in rviz.remappings.values():
            assert (shown if shown.startswith("/") else f"/{rviz.namespace}/{shown}") in names


def test_several_cameras_have_a_view_each() -> None:
    found = processes(
        LAUNCH / "stream_depth_cameras.launch.py", cameras="[front, rear]", image="raw", rviz="true"
    )
    ours, *views = found
    assert ours.values["cameras"] == ["front", "rear"]
    assert [one.name for one in views] == ["rviz_front", "rviz_rear"]
    with own_domain() as domain, made_node(domain, ours.command_line) as node:
        assert node.trigger_configure() == SUCCESS
        names = {name for name, _ in node.get_topic_names_and_types()}
        for view in views:
            assert set(view.remappings.values()) <= names


def test_a_misspelt_argument_is_found() -> None:
    with pytest.raises(AssertionError, match=r"declares no \['imgae'\]"):
        processes(LAUNCH / "stream_depth.launch.py", imgae="/x")
