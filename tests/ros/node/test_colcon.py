"""The repository as a colcon workspace: where the executable goes, and that it runs."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from rclpy.qos import qos_profile_sensor_data

from dyfn_core.models import save_model
from dyfn_core.models.mini import MiniConfig, MiniModel
from tests.support.ros_graph import Client, NodeProcess, frames, own_domain

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]
TESTS = ("test_encodings.py", "test_compressed_depth.py")
PARTS = ("dyfn_core", "dyfn_ros", "resource", "launch", "config")
FILES = ("package.xml", "pyproject.toml", "setup.py", "setup.cfg", "LICENSE", "README.md")


@pytest.fixture(scope="module")
def install(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """install/dyfn_ros of a fresh workspace that holds a copy of this repository."""
    workspace = tmp_path_factory.mktemp("workspace")
    source = workspace / "src/dyfn_ros"
    source.mkdir(parents=True)
    heavy = shutil.ignore_patterns("__pycache__", "*.safetensors")
    for name in PARTS:
        shutil.copytree(ROOT / name, source / name, ignore=heavy)
    (source / "tests").mkdir()
    for name in TESTS:
        shutil.copy(ROOT / "tests/ros/messages" / name, source / "tests" / name)
    for name in FILES:
        shutil.copy(ROOT / name, source / name)
    command = [sys.executable, "-m", "colcon", "build", "--executor", "sequential"]
    built = subprocess.run(command, cwd=workspace, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    return workspace / "install/dyfn_ros"


def test_everything_is_where_ros_looks_for_it(install: Path) -> None:
    assert (install / "lib/dyfn_ros/stream_depth").stat().st_mode & 0o111
    share = install / "share/dyfn_ros"
    names = ["package.xml", "config/stream_depth.yaml"]
    for folder in ("launch", "config/cameras", "config/recipes"):
        names += [f"{folder}/{path.name}" for path in (ROOT / folder).glob("*.*")]
    for name in names:
        assert (share / name).is_file(), name
    assert (install / "share/ament_index/resource_index/packages/dyfn_ros").is_file()


def test_colcon_runs_the_tests_and_reports_them(install: Path) -> None:
    workspace = install.parents[1]
    colcon = [sys.executable, "-m", "colcon"]
    run = [*colcon, "test", "--executor", "sequential", "--return-code-on-test-failure"]
    tested = subprocess.run(run, cwd=workspace, capture_output=True, text=True)
    assert tested.returncode == 0, tested.stdout + tested.stderr
    result = [*colcon, "test-result", "--all"]
    report = subprocess.run(result, cwd=workspace, capture_output=True, text=True).stdout
    found = re.search(r"Summary: (\d+) tests, 0 errors, 0 failures", report)
    assert found, report
    assert int(found[1]) > 100


def test_the_installed_node_runs_with_its_parameter_file(install: Path, tmp_path: Path) -> None:
    """As `ros2 run` would start it, with a checkpoint loaded from a file."""
    checkpoint = tmp_path / "small.safetensors"
    small = MiniConfig(latent_channels=8, stage_channels=(8,), context_layers=0, num_tokens=12)
    save_model(MiniModel(small), checkpoint)
    parameters = install / "share/dyfn_ros/config/stream_depth.yaml"
    script = f'. "{install.parent}/setup.sh" && exec "$0" "$@"'
    command = [
        *("sh", "-c", script, str(install / "lib/dyfn_ros/stream_depth")),
        *("--ros-args", "--params-file", str(parameters), "-p", f"model:={checkpoint}"),
    ]
    with own_domain() as domain:
        node = NodeProcess(command, domain, tmp_path)
        client = Client(domain, image_qos=qos_profile_sensor_data)
        client.prime()
        result = client.result(client.send(frames(1)[0]))
        assert (result["depth/image"].height, result["depth/image"].width) == (36, 48)
        client.close()
        assert node.end() == 0, node.log
        assert str(checkpoint) in node.log
