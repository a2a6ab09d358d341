"""What a process of the package sets in its environment, and what it leaves alone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from dyfn_ros.node import environment

PARTICIPANT = """
from dyfn_ros.node.environment import prepare_environment
prepare_environment()
import os, rclpy
rclpy.init()
rclpy.create_node("participant").destroy_node()
rclpy.try_shutdown()
print(os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"])
"""


@pytest.fixture
def variables(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, str]:
    """An empty environment, and a working directory without a profile."""
    empty: dict[str, str] = {}
    monkeypatch.setattr(environment.os, "environ", empty)
    monkeypatch.chdir(tmp_path)
    return empty


def _prefix(folder: Path, holds_ros: bool) -> str:
    packages = folder / "share/ament_index/resource_index/packages"
    packages.mkdir(parents=True)
    if holds_ros:
        (packages / "rclpy").touch()
    return str(folder)


def test_a_virtual_environment_becomes_a_ros_prefix_unless_ros_is_sourced(
    variables: dict[str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    venv, plain = _prefix(tmp_path / "venv", True), _prefix(tmp_path / "plain", False)
    overlay, ros = _prefix(tmp_path / "overlay", False), _prefix(tmp_path / "ros", True)
    cases = [
        (venv, None, venv),
        (venv, "", venv),
        (venv, overlay, f"{overlay}:{venv}"),
        (venv, f"{overlay}:{ros}", f"{overlay}:{ros}"),
        (plain, None, None),
        (plain, overlay, overlay),
    ]
    for sys_prefix, before, after in cases:
        variables.clear()
        variables.update({} if before is None else {"AMENT_PREFIX_PATH": before})
        monkeypatch.setattr(environment, "sys", SimpleNamespace(prefix=sys_prefix))
        environment.prepare_environment()
        assert variables.get("AMENT_PREFIX_PATH") == after


def test_profile_and_wait_policy_are_set_where_nobody_chose(variables: dict[str, str]) -> None:
    environment.prepare_environment()
    assert variables["FASTRTPS_DEFAULT_PROFILES_FILE"] == str(environment.FASTDDS_PROFILE)
    assert variables["OMP_WAIT_POLICY"] == "PASSIVE"


@pytest.mark.parametrize(
    "name", ["FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"]
)
def test_a_chosen_profile_stays_the_only_one(variables: dict[str, str], name: str) -> None:
    variables.update({name: "mine.xml", "OMP_WAIT_POLICY": "ACTIVE"})
    environment.prepare_environment()
    assert {key: value for key, value in variables.items() if "PROFILES" in key} == {
        name: "mine.xml"
    }
    assert variables["OMP_WAIT_POLICY"] == "ACTIVE"


def test_a_profile_in_the_working_directory_stays_the_only_one(variables: dict[str, str]) -> None:
    Path("DEFAULT_FASTRTPS_PROFILES.xml").touch()
    environment.prepare_environment()
    assert "FASTRTPS_DEFAULT_PROFILES_FILE" not in variables


def test_fast_dds_accepts_the_profile(tmp_path: Path) -> None:
    clean = {key: value for key, value in os.environ.items() if "PROFILES_FILE" not in key}
    clean |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "91"}
    clean["PYTHONPATH"] = str(Path(__file__).resolve().parents[3])
    done = subprocess.run(
        [sys.executable, "-c", PARTICIPANT],
        env=clean,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert done.stdout.strip().endswith("fastdds_images.xml")
    assert "rror" not in done.stderr + done.stdout
