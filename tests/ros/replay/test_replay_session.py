"""dyfn-replay's stream options: the node's names and defaults, metres, references, saved state."""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from dyfn_core.geometry.projection import back_project
from dyfn_core.scoring.metrics import depth_metrics
from dyfn_core.stream.options import options_of
from dyfn_ros.messages.images import decode_depth
from dyfn_ros.node.parameters.table import SPECS
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording
from dyfn_ros.recordings.typestore import IMAGE, POINT_CLOUD, TYPES, header
from dyfn_ros.recordings.writer import RecordingWriter
from dyfn_ros.replay.cli import main
from dyfn_ros.replay.jobs import ALL, PARTIAL, UNUSABLE
from dyfn_ros.replay.options import parse, parser
from dyfn_ros.replay.settings import Run, SessionOptions
from tests.core.stream.test_scene_cut import scene, seen
from tests.support.rgbd_frames import CAMERA, SIZE, rgbd
from tests.support.tiny_model import load_tiny

Measured = tuple[float, np.ndarray]  # seconds, N x 3 metres
FIXED = ("--metric-source", "fixed", "--metric-scale", "2.5")


def run(recording: Path, out: Path, *options: str) -> int:
    fixed = ["--out", str(out), "--model", "tiny", "--threads", "1", "--write", "raw"]
    return main([str(recording), *fixed, *options], load_tiny)


def metrics(out: Path) -> dict[str, Any]:
    return json.loads((out / "metrics.json").read_text())


def depths(out: Path) -> list[np.ndarray]:
    with Reader(out / "output.mcap") as reader:
        return [
            decode_depth(TYPES.deserialize_cdr(data, IMAGE))
            for connection, _, data in reader.messages()
            if connection.topic == "/stream_depth/depth/image"
        ]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "walk"
    write_rgbd_recording(path, rgbd(5), jpeg_quality=None, depth_encoding="32FC1")
    return path


def options_by_name() -> dict[str, argparse.Action]:
    return {action.dest: action for action in parser()._actions}


def test_every_stream_parameter_of_the_node_is_an_option_with_its_default() -> None:
    names = [*options_of(SessionOptions), "model", "device", "backend", "threads"]
    assert set(names) <= SPECS.keys()
    job = parse(["walk", "--out", "out"]).job
    assert isinstance(job.run, Run)
    given = {**vars(job.run.stream), **vars(job.run)}
    assert {name: given[name] for name in names} == {name: SPECS[name].default for name in names}
    assert set(names) <= options_by_name().keys()


def test_every_option_reaches_the_session() -> None:
    other = {int: "7", float: "0.125", str: "x"}
    for name, described in options_of(SessionOptions).items():
        value = getattr(SessionOptions(), name)
        flag = f"--{name.replace('_', '-')}"
        if isinstance(value, bool):
            words = [flag.replace("--", "--no-") if value else flag]
        else:
            words = [flag, described.choices[-1] if described.choices else other[type(value)]]
        if name == "state_file":
            words.append("--load-state")
        found = parse(["walk", "--out", "out", *words]).job.run
        assert isinstance(found, Run)
        usual, chosen = vars(SessionOptions()), vars(found.stream)
        assert {key for key in usual if chosen[key] != usual[key]} == {name}


def test_old_names_warn(capsys: pytest.CaptureFixture[str]) -> None:
    found = parse(["walk", "--out", "out", "--no-stabilizer"]).job.run
    assert isinstance(found, Run) and not found.stream.stabilize
    assert "--no-stabilizer is deprecated, use --no-stabilize" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--load-state"], "need --state-file"),
        (["--state-file", "s"], "no effect without --load-state or --save-state"),
        (["--reference-topic", "/cloud"], "no effect without --metric-source reference"),
        (["--metric-source", "gps"], "--metric-source"),
        (["--max-gap", "-1"], "--max-gap: expected a number from 0 to 1000000, got '-1'"),
    ],
)
def test_contradictions_are_refused_in_one_line(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        parse(["walk", "--out", "out", *words])
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1


def test_metres_are_scored_without_alignment(recording: Path, tmp_path: Path) -> None:
    assert run(recording, tmp_path / "plain") == ALL
    assert run(recording, tmp_path / "out", *FIXED) == ALL
    plain, found = metrics(tmp_path / "plain"), metrics(tmp_path / "out")
    assert "metric" not in plain and "metric_scale" not in plain
    assert found["metric_scale"]["unit"] == "metres"
    assert found["options"]["metric_source"] == "fixed"
    expected = []
    for relative, depth, frame in zip(
        depths(tmp_path / "plain"), depths(tmp_path / "out"), rgbd(5), strict=True
    ):
        np.testing.assert_array_equal(depth, relative * np.float32(2.5))
        truth = np.asarray(frame.depth_m, np.float32)
        valid = np.isfinite(depth) & (truth > 0)
        expected.append(depth_metrics(depth[valid].astype(np.float64), truth[valid]))
    for name in ("abs_rel", "delta1"):
        mean = np.mean([one[name] for one in expected])
        assert found["metric"][name] == pytest.approx(mean, rel=1e-5)
    with (tmp_path / "out" / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["metric_abs_rel"]) for row in rows] == pytest.approx(
        [one["abs_rel"] for one in expected], rel=1e-5
    )
    assert "metric AbsRel" in (tmp_path / "out" / "report.html").read_text()
    assert "metric AbsRel" not in (tmp_path / "plain" / "report.html").read_text()


def test_a_cloud_in_metres_needs_no_truth(tmp_path: Path) -> None:
    frames = [
        FrameToRecord(f.image, None, CAMERA, np.eye(4), f.stamp) for f in rgbd(2, truth=False)
    ]
    write_rgbd_recording(tmp_path / "walk", frames)
    assert run(tmp_path / "walk", tmp_path / "plain", "--write", "ply") == ALL
    assert not (tmp_path / "plain" / "cloud.ply").exists()
    assert run(tmp_path / "walk", tmp_path / "out", "--write", "ply", *FIXED) == ALL
    assert (tmp_path / "out" / "cloud.ply").exists()


def measured(
    path: Path, clouds: list[Measured], damaged: bool = False, frame_id: str = "camera"
) -> Path:
    """Five images with their truth, a second apart from 1 s on, and clouds logged at their time."""
    events: list[tuple[float, Any]] = [(1.0 + i, frame) for i, frame in enumerate(rgbd(5))]
    events += clouds
    with RecordingWriter(path, overwrite=True) as writer:
        for second, event in sorted(events, key=lambda pair: pair[0]):
            stamp = round(second * 1e9)
            if isinstance(event, FrameToRecord):
                writer.write_image("/image", event.image, stamp, "camera")
                writer.write_camera_info("/camera_info", CAMERA, SIZE, stamp, "camera")
                writer.write_depth("/depth", np.asarray(event.depth_m), stamp, "camera")
            else:
                message = point_cloud(event, stamp, frame_id)
                if damaged:
                    message.fields = message.fields[:2]
                writer.write("/lidar", POINT_CLOUD, message, stamp)
    return path


def point_cloud(points: np.ndarray, stamp_ns: int, frame_id: str) -> Any:
    field = TYPES.types["sensor_msgs/msg/PointField"]
    return TYPES.types[POINT_CLOUD](
        header=header(stamp_ns, frame_id),
        height=1,
        width=len(points),
        fields=[field(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")],
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(points),
        data=np.ascontiguousarray(points, "<f4").reshape(-1).view(np.uint8),
        is_dense=True,
    )


CUTS_OFF = ("--scene-cut-threshold", "0")  # the images have nothing in common
REFERENCE = ("--metric-source", "reference", "--calibration-seconds", "2", *CUTS_OFF)


def predicted_clouds(tmp_path: Path) -> list[Measured]:
    """What the model predicts of the images, times 3, half a tenth of a second before each."""
    run(measured(tmp_path / "images.mcap", []), tmp_path / "relative", *CUTS_OFF)
    return [
        (0.95 + index, (3 * back_project(depth, CAMERA))[::20])
        for index, depth in enumerate(depths(tmp_path / "relative"))
    ]


def test_a_reference_topic_gives_metres_and_what_is_not_used_is_counted(tmp_path: Path) -> None:
    clouds = predicted_clouds(tmp_path)
    path = measured(tmp_path / "walk.mcap", [(0.5, clouds[0][1]), *clouds])
    assert run(path, tmp_path / "out", *REFERENCE) == ALL
    found = metrics(tmp_path / "out")
    assert float(found["metric_scale"]["scale"]) == pytest.approx(3, rel=0.02)
    relative, metric = depths(tmp_path / "relative"), depths(tmp_path / "out")
    assert np.isnan(metric[0]).all()  # withheld until two seconds are measured
    np.testing.assert_allclose(metric[-1], relative[-1] * 3, rtol=0.02)
    warnings = found["recording"]["warnings"]
    assert warnings["/lidar: measurements or points not used: stale"] == 1
    known = sum(bool(np.isfinite(depth).any()) for depth in metric)
    with (tmp_path / "out" / "frames.csv").open() as file:
        rows = [row["metric_abs_rel"] for row in csv.DictReader(file)]
    assert sum(bool(row) for row in rows) == known < 5


def test_a_measurement_is_not_used_before_it_was_recorded(tmp_path: Path) -> None:
    """Recorded just after each image: they count from the next image on, or not at all."""
    clouds = predicted_clouds(tmp_path)
    late = [(second + 0.06, points) for second, points in clouds]
    path = measured(tmp_path / "walk.mcap", late)
    assert run(path, tmp_path / "out", *REFERENCE) == ALL
    known = [bool(np.isfinite(depth).any()) for depth in depths(tmp_path / "out")]
    assert known == [False, False, False, True, True]
    found = metrics(tmp_path / "out")
    assert float(found["metric_scale"]["scale"]) == pytest.approx(3, rel=0.02)
    assert run(path, tmp_path / "out", *REFERENCE, "--reference-history", "0") == ALL
    found = metrics(tmp_path / "out")
    assert found["metric_scale"]["unit"] == "relative"
    assert found["recording"]["warnings"] == {
        "scale: no measurement yet": 1,
        "/lidar: measurements or points not used: stale": 4,  # the fifth is after the last image
    }
    assert "metric" not in found


def test_a_sensor_whose_place_is_unknown_gives_no_metres(tmp_path: Path) -> None:
    path = measured(tmp_path / "walk.mcap", predicted_clouds(tmp_path), frame_id="lidar")
    assert run(path, tmp_path / "out", *REFERENCE) == PARTIAL
    found = metrics(tmp_path / "out")
    assert found["metric_scale"]["unit"] == "relative"
    (loss,) = found["recording"]["losses"].items()
    assert "its frame_id is 'lidar', the images are of 'camera', and tf has no frame" in loss[0]
    assert loss[1] == 5
    text = "/lidar: measurements or points not used: sensor's place unknown"
    assert found["recording"]["warnings"][text] == 5


def test_measurements_that_cannot_be_read_are_losses(tmp_path: Path) -> None:
    path = measured(tmp_path / "walk.mcap", predicted_clouds(tmp_path), damaged=True)
    assert run(path, tmp_path / "out", *REFERENCE) == PARTIAL
    (loss,) = metrics(tmp_path / "out")["recording"]["losses"].items()
    assert loss[0].startswith("/lidar: measurement skipped: the cloud has fields ['x', 'y']")
    assert loss[1] == 5


def test_a_reference_that_is_not_there_is_named(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(recording, tmp_path / "out", *REFERENCE) == UNUSABLE
    assert "no topic of sensor_msgs/msg/PointCloud2" in capsys.readouterr().err
    images = [*REFERENCE, "--reference-type", "Image", "--calibration-seconds", "0.01"]
    assert run(recording, tmp_path / "out", *images) == ALL
    warnings = metrics(tmp_path / "out")["recording"]["warnings"]
    assert any("both the reference and the ground truth" in text for text in warnings)


def halves(folder: Path) -> tuple[Path, Path, Path]:
    frames = rgbd(4)
    parts = {"whole": frames, "first": frames[:2], "rest": frames[2:]}
    for name, part in parts.items():
        write_rgbd_recording(folder / name, part, jpeg_quality=None)
    return folder / "whole", folder / "first", folder / "rest"


def test_a_saved_state_joins_two_recordings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, first, rest = halves(tmp_path)
    state = (*CUTS_OFF, "--state-file", str(tmp_path / "state"))
    assert run(whole, tmp_path / "a", *CUTS_OFF) == ALL
    assert run(first, tmp_path / "b", *state, "--save-state") == ALL
    assert "state: saved 2 frames' memory" in capsys.readouterr().out
    assert run(rest, tmp_path / "c", *state, "--load-state", "--compare") == ALL
    expected, found = depths(tmp_path / "a")[2:], depths(tmp_path / "c")
    np.testing.assert_array_equal(np.stack(found), np.stack(expected))
    warnings = metrics(tmp_path / "c")["recording"]["warnings"]
    assert warnings == {"--load-state: base model and controls started without the saved state": 1}
    assert run(rest, tmp_path / "d", *CUTS_OFF) == ALL
    assert not np.array_equal(np.stack(depths(tmp_path / "d")), np.stack(expected))


def test_a_state_that_cannot_be_used_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, first, rest = halves(tmp_path)
    for file, option, told in (
        (tmp_path / "none", "--load-state", "No such file"),
        (tmp_path / "no" / "where", "--save-state", "is no folder"),
    ):
        assert run(whole, tmp_path / "out", "--state-file", str(file), option) == UNUSABLE
        error = capsys.readouterr().err
        assert told in error and "Traceback" not in error
        assert not (tmp_path / "out" / "metrics.json").exists()
    several = [str(first), str(rest), "--out", str(tmp_path / "out"), "--model", "tiny"]
    state = ["--state-file", str(tmp_path / "state"), "--save-state"]
    assert main([*several, *state], load_tiny) == UNUSABLE
    assert "for one recording" in capsys.readouterr().err


@pytest.mark.parametrize("cut", [True, False])
def test_what_the_stride_leaves_out_is_looked_at_for_scene_cuts(tmp_path: Path, cut: bool) -> None:
    """Frames 0.6 s apart have nothing in common by the camera's motion alone."""
    path = tmp_path / "walk"
    views = [seen(scene(7 + (cut and index > 13), 960), 30 * (index % 22)) for index in range(22)]
    frames = [
        FrameToRecord(cv2.resize(view, (96, 72)), None, CAMERA, None, 50 + index / 10)
        for index, view in enumerate(views)
    ]
    write_rgbd_recording(path, frames, jpeg_quality=None)
    assert run(path, tmp_path / "out", "--stride", "6") in (ALL, PARTIAL)
    found = metrics(tmp_path / "out")
    assert found["resets"] == ({"scene cut": 1} if cut else {})
    assert found["frames"] == 4
