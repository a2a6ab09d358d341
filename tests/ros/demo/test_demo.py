"""dyfn-demo: a live node in another process, over DDS, and no process left behind."""

import html
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dyfn_ros.demo.cli import FAILED, OK, UNUSABLE, main
from dyfn_ros.demo.node_process import LiveError, NodeExitError, NodeProcess
from dyfn_ros.recordings.rgbd_writer import write_rgbd_recording
from dyfn_ros.replay import cli as replay
from tests.support.plane_drive import drive, plane_folder
from tests.support.rgbd_frames import rgbd
from tests.support.ros_graph import DEADLINE, own_domain
from tests.support.tiny_model import load_tiny

pytestmark = pytest.mark.slow

TINY_NODE = [sys.executable, "-m", "tests.support.tiny_node"]


def play(recording: Path, out: Path, command: list[str], model: str = "tiny") -> int:
    with own_domain() as domain:
        where = [str(recording), "--out", str(out)]
        return main([*where, "--model", model, "--domain", domain["ROS_DOMAIN_ID"]], command)


@pytest.mark.parametrize("raw", [True, False], ids=["raw", "compressed"])
def test_live_is_scored_and_equals_the_replay_byte_for_byte(
    tmp_path: Path, raw: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    write_rgbd_recording(tmp_path / "walk", rgbd(4), jpeg_quality=None if raw else 90)
    assert play(tmp_path / "walk", tmp_path / "out", TINY_NODE) == OK
    runs = json.loads((tmp_path / "out" / "metrics.json").read_text())["runs"]
    resets = 2  # before each run
    for name, option in (("DyFN", []), ("base", ["--no-stabilize"])):
        offline = [str(tmp_path / "walk"), "--out", str(tmp_path / "offline"), "--model", "tiny"]
        assert replay.main([*offline, *option], load_tiny) == OK
        expected = json.loads((tmp_path / "offline" / "metrics.json").read_text())
        assert runs[name]["frames"] == 4
        assert runs[name]["output_sha256"] == expected["output_sha256"]
        assert runs[name]["video"] == expected["video"]
        resets += sum(expected["resets"].values())
    hashes = {run["output_sha256"] for run in runs.values()}
    assert len(hashes) == 2
    text = capsys.readouterr().out
    assert "control: ramp" in text and "4 frames of" in text
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count('class="frames"') == 2  # strip of both runs, worst frames of the first
    log = (tmp_path / "out" / "node.log").read_text()
    assert "0 dropped" in log and f"{resets} resets" in log


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag with odometry of the camera itself."""
    path = tmp_path_factory.mktemp("plane")
    folder = plane_folder(path / "folder")
    return drive(folder, path / "walk.mcap", mount=np.eye(4), child="camera_optical")


def test_a_recording_with_odometry_is_played_three_ways(
    plane: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert play(plane, tmp_path, TINY_NODE, model="pinhole with DyFN") == OK
    runs = json.loads((tmp_path / "metrics.json").read_text())["runs"]
    assert list(runs) == ["base", "DyFN", "DyFN + odometry"]
    assert all(run["frames"] == 60 for run in runs.values())
    assert "metric" not in runs["base"] and "metric" not in runs["DyFN"]
    assert runs["DyFN + odometry"]["metric"]["abs_rel"] < 0.1
    text = capsys.readouterr().out
    assert "DyFN + odometry is in metres: AbsRel 0.0" in text.splitlines()[0]
    said = re.search(r"is in metres from (\d\.\d) s on; (\d+) of 60 frames", text)
    assert said and 0 < int(said[2]) < 50
    # What is compared is compared on the same frames.
    assert {run["scored_frames"] for run in runs.values()} == {60 - int(said[2])}
    page = (tmp_path / "report.html").read_text()
    assert text.splitlines()[0] in html.unescape(page)
    assert "0 dropped" in (tmp_path / "node_odometry.log").read_text()


def test_a_node_that_cannot_start_is_a_clear_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_rgbd_recording(tmp_path / "walk", rgbd(2))
    assert play(tmp_path / "walk", tmp_path / "out", TINY_NODE, model="huge") == FAILED
    error = capsys.readouterr().err
    assert "the node ended with code 1" in error
    assert "model 'huge' is unknown" in error


def test_a_missing_recording_starts_no_node(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert play(tmp_path / "nowhere", tmp_path / "out", TINY_NODE) == UNUSABLE
    assert "does not exist" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_demo_and_its_node(tmp_path: Path, number: int) -> None:
    write_rgbd_recording(tmp_path / "walk", rgbd(2))
    script = tmp_path / "endless_node.py"
    script.write_text(
        "import os, sys, time\n"
        f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid()))\n"
        "print('up', flush=True)\n"
        "time.sleep(600)\n"
    )
    code = (
        "import signal, sys\nfrom dyfn_ros.demo.cli import main\n"
        # a shell's background job inherits an ignored SIGINT
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"sys.exit(main(sys.argv[1:], [sys.executable, {str(script)!r}]))"
    )
    where = [str(tmp_path / "walk"), "--out", str(tmp_path / "out")]
    with own_domain() as domain:
        demo = subprocess.Popen(
            [sys.executable, "-c", code, *where, "--domain", domain["ROS_DOMAIN_ID"]],
            stderr=subprocess.PIPE,
            text=True,
        )
        assert demo.stderr is not None
        for line in demo.stderr:
            if "waiting for the node" in line:
                break
        demo.send_signal(number)
        _, error = demo.communicate(timeout=DEADLINE)
    assert demo.returncode == 130
    assert "interrupted" in error
    pid = (tmp_path / "pid").read_text() if (tmp_path / "pid").exists() else None
    if pid:
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid), 0)


def test_the_node_process_takes_parameters_and_is_stopped(tmp_path: Path) -> None:
    echo = "import sys, time; print(sys.argv[1:], flush=True); time.sleep(600)"
    with NodeProcess(
        tmp_path / "node.log",
        {"drop_frames": False, "model": "tiny"},
        "/mine",
        [sys.executable, "-c", echo],
    ) as process:
        process.check()
        pid = process.pid
        while "]" not in process.log.read_text():
            process.check()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    log = process.log.read_text()
    assert re.search(r"'__ns:=/mine', '-p', 'drop_frames:=false', '-p', 'model:=tiny'", log)


def test_a_node_that_ignores_signals_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deaf = (
        "import signal, time\n"
        "for s in (signal.SIGINT, signal.SIGTERM): signal.signal(s, signal.SIG_IGN)\n"
        "print('deaf', flush=True); time.sleep(600)"
    )
    monkeypatch.setattr("dyfn_ros.demo.node_process.PATIENCE", (0.2, 0.2))
    process = NodeProcess(tmp_path / "node.log", {}, "/", [sys.executable, "-c", deaf])
    while "deaf" not in process.log.read_text():
        process.check()
    assert process.stop() == -signal.SIGKILL
    with pytest.raises(NodeExitError, match=r"code -9; the end of .*node.log:\ndeaf"):
        process.check()
    assert issubclass(NodeExitError, LiveError)
