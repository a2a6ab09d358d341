"""dyfn-replay: what it writes is right, complete and the same each time."""

import csv
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from dyfn_core.evaluation.benchmarks.model_method import as_array
from dyfn_core.geometry.l1_fit import fit_scale_shift
from dyfn_core.models.controls import latent_controls, stabilized_by
from dyfn_core.scoring.protocols import SequenceScorer
from dyfn_core.stream.depth_stream import DepthStream
from dyfn_core.threads import THREADS
from dyfn_ros.messages.clouds import cloud_points
from dyfn_ros.messages.images import decode_depth
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording
from dyfn_ros.recordings.typestore import IMAGE, TYPES
from dyfn_ros.recordings.writer import RecordingWriter
from dyfn_ros.replay.cli import main
from dyfn_ros.replay.jobs import ALL, PARTIAL, UNUSABLE
from dyfn_ros.replay.options import parse
from dyfn_ros.replay.run import load
from dyfn_ros.replay.settings import PredictionTopic
from tests.support.rgbd_frames import CAMERA, SIZE, rgbd
from tests.support.tiny_model import load_tiny


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "walk"
    write_rgbd_recording(path, rgbd(5), jpeg_quality=None, depth_encoding="32FC1")
    return path


def run(recording: Path, out: Path, *options: str) -> int:
    fixed = ["--out", str(out), "--model", "tiny", "--threads", "1"]
    return main([str(recording), *fixed, *options], load_tiny)


def metrics(out: Path) -> dict[str, Any]:
    return json.loads((out / "metrics.json").read_text())


def output(out: Path) -> dict[str, list]:
    read: dict[str, list] = {}
    with Reader(out / "output.mcap") as reader:
        for connection, _, data in reader.messages():
            message = TYPES.deserialize_cdr(data, connection.msgtype)
            read.setdefault(connection.topic, []).append(message)
    return read


def test_it_writes_everything(recording: Path, tmp_path: Path) -> None:
    assert run(recording, tmp_path / "out") == ALL
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "frames.csv",
        "metrics.json",
        "output.foxglove.json",
        "output.mcap",
        "report.html",
        "strip.png",
        "video.mp4",
    ]
    found = metrics(tmp_path / "out")
    assert (found["frames"], found["model"], found["stabilizer"]) == (5, "tiny", True)
    assert found["image"]["abs_rel"] <= found["video"]["abs_rel"] + 1e-9
    assert 0 < found["image"]["delta1"] <= 1
    assert 0 < found["latency_ms"]["p50"] <= found["latency_ms"]["p99"]
    assert set(found["controls"]) == {"ramp", "constant"}
    with (tmp_path / "out" / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == ["0", "1", "2", "3", "4"]
    assert float(rows[3]["stamp"]) == pytest.approx(50.2)
    mean = np.mean([float(row["video_abs_rel"]) for row in rows])
    assert mean == pytest.approx(found["video"]["abs_rel"])
    strip = cv2.imread(str(tmp_path / "out" / "strip.png"))
    assert strip.shape[1] > 4 * 200 and strip.std() > 20
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count('class="frames"') == 2  # strip, worst frames
    assert page.count('role="img"') == 5 + 1  # curves, latency; the cloud
    assert "http" not in page
    assert "tiny with DyFN" in page


def test_compare_runs_the_base_on_the_same_frames(recording: Path, tmp_path: Path) -> None:
    assert run(recording, tmp_path / "both", "--compare") == ALL
    assert run(recording, tmp_path / "base", "--no-stabilize") == ALL
    both, base = metrics(tmp_path / "both"), metrics(tmp_path / "base")
    for key in ("frames", "video", "image", "output_sha256", "spread"):
        assert both["base"][key] == base[key]
    assert both["output_sha256"] != base["output_sha256"]
    page = (tmp_path / "both" / "report.html").read_text()
    assert page.count('class="frames"') == 2
    assert "tiny, base model: " in page  # beside each key figure
    assert "tiny with DyFN" in page and "tiny, base model" in page
    assert "base" not in base


def test_scores_are_those_of_the_depth_in_the_output(recording: Path, tmp_path: Path) -> None:
    run(recording, tmp_path / "out", "--write", "raw")
    errors, predictions, truths = [], [], []
    for message, frame in zip(
        output(tmp_path / "out")["/stream_depth/depth/image"], rgbd(5), strict=True
    ):
        depth, truth = decode_depth(message), np.asarray(frame.depth_m, np.float32)
        valid = np.isfinite(depth) & (truth > 0)
        p, d = depth[valid], truth[valid]
        scale, shift = fit_scale_shift(p, d, 1 / d)
        errors.append(np.mean(np.abs(np.maximum(scale * p + shift, 1e-3) - d) / d))
        predictions.append(p)
        truths.append(d)
    assert metrics(tmp_path / "out")["image"]["abs_rel"] == pytest.approx(np.mean(errors), rel=1e-4)
    d = np.concatenate(truths)
    scale, shift = fit_scale_shift(np.concatenate(predictions), d, 1 / d)
    alignment = metrics(tmp_path / "out")["alignment"]
    assert alignment == pytest.approx({"scale": scale, "shift": shift}, rel=1e-3)


def test_the_output_recording_is_what_foxglove_needs(recording: Path, tmp_path: Path) -> None:
    run(recording, tmp_path / "out", "--write", "raw")
    read = output(tmp_path / "out")
    assert {topic: len(found) for topic, found in read.items()} == {
        "/camera/image/compressed": 5,
        "/camera/camera_info": 5,
        "/camera/ground_truth/image": 5,
        "/stream_depth/depth/image": 5,
        "/stream_depth/depth/camera_info": 5,
        "/stream_depth/points": 5,
        "/stream_depth/median_depth": 5,
        "/stream_depth/scale": 5,
        "/stream_depth/shift": 5,
        "/stream_depth/abs_rel": 5,
    }
    with (tmp_path / "out" / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    for name, column in (("scale", "scale"), ("shift", "shift"), ("abs_rel", "image_abs_rel")):
        values = [message.data for message in read[f"/stream_depth/{name}"]]
        assert values == pytest.approx([float(row[column]) for row in rows])
    depth = read["/stream_depth/depth/image"][2]
    assert (depth.encoding, depth.header.frame_id) == ("32FC1", "camera_optical")
    assert not (depth.data.view(np.float32) == 0).any()
    cloud = cloud_points(read["/stream_depth/points"][2])
    valid = np.isfinite(cloud["z"])
    np.testing.assert_array_equal(cloud["z"][valid], decode_depth(depth)[valid])
    v, u = np.nonzero(valid)
    found = cloud[valid]
    np.testing.assert_allclose(found["x"] / found["z"] * 40 + 23.5, u, atol=1e-3)
    np.testing.assert_allclose(found["y"] / found["z"] * 40 + 17.5, v, atol=1e-3)
    with (tmp_path / "out" / "output.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == 50
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    assert "float64 data" in next(
        s.data.decode() for s in summary.schemas.values() if s.name == "std_msgs/msg/Float64"
    )


def test_the_same_recording_gives_the_same_hash_whatever_the_storage(tmp_path: Path) -> None:
    hashes = []
    for name in ("a", "a", "b.mcap", "c.db3"):
        if not (tmp_path / name).exists():
            write_rgbd_recording(tmp_path / name, rgbd(3))
        run(tmp_path / name, tmp_path / "out", "--no-output-recording")
        hashes.append(metrics(tmp_path / "out")["output_sha256"])
    assert len(set(hashes)) == 1
    run(tmp_path / "a", tmp_path / "out", "--no-stabilize", "--no-output-recording")
    assert metrics(tmp_path / "out")["output_sha256"] != hashes[0]
    assert metrics(tmp_path / "out")["stabilizer"] is False


def test_without_truth_there_are_no_scores(tmp_path: Path) -> None:
    write_rgbd_recording(tmp_path / "walk", rgbd(3, truth=False))
    assert run(tmp_path / "walk", tmp_path / "out") == ALL
    found = metrics(tmp_path / "out")
    assert found["image"] is None and found["video"] is None and found["spread"] is None
    assert found["latency_ms"]["p50"] > 0
    assert (tmp_path / "out" / "strip.png").exists()


def test_depth_topic_none_turns_the_scores_off(recording: Path, tmp_path: Path) -> None:
    assert run(recording, tmp_path / "out", "--depth-topic", "none") == ALL
    assert metrics(tmp_path / "out")["image"] is None


def test_frames_can_be_limited_and_thinned(recording: Path, tmp_path: Path) -> None:
    run(recording, tmp_path / "out", "--max-frames", "2", "--stride", "2")
    with (tmp_path / "out" / "frames.csv").open() as file:
        stamps = [float(row["stamp"]) for row in csv.DictReader(file)]
    assert stamps == pytest.approx([50, 50 + 2 / 15])


def test_truth_of_another_resolution_is_compared_at_its_pixels(tmp_path: Path) -> None:
    half = [
        FrameToRecord(f.image, f.depth_m[1::2, 1::2], CAMERA, None, f.stamp)  # type: ignore[index]
        for f in rgbd(3)
    ]
    write_rgbd_recording(tmp_path / "walk", half)
    assert run(tmp_path / "walk", tmp_path / "out") == ALL
    write_rgbd_recording(tmp_path / "full", rgbd(3))
    run(tmp_path / "full", tmp_path / "other")
    ours, full = metrics(tmp_path / "out"), metrics(tmp_path / "other")
    assert ours["image"]["abs_rel"] == pytest.approx(full["image"]["abs_rel"], rel=0.1)


def test_truth_of_another_field_of_view_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = [FrameToRecord(f.image, f.depth_m[:, :20], CAMERA, None, f.stamp) for f in rgbd(2)]  # type: ignore[index]
    write_rgbd_recording(tmp_path / "walk", cut)
    assert run(tmp_path / "walk", tmp_path / "out") == UNUSABLE
    assert "/camera/depth/image/compressed: ground truth of 20 x 36" in capsys.readouterr().err
    assert not (tmp_path / "out" / "metrics.json").exists()
    assert not (tmp_path / "out" / "output.mcap").exists()


def test_a_damaged_recording_is_used_as_far_as_it_goes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "walk.mcap"
    rng = np.random.default_rng(0)
    with RecordingWriter(path) as writer:
        for index in range(40):
            image = rng.integers(0, 255, (120, 160, 3), np.uint8)
            writer.write_image("/image", image, index, "camera")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 4])
    assert run(path, tmp_path / "out", "--no-output-recording") == PARTIAL
    found = metrics(tmp_path / "out")
    assert 0 < found["frames"] < 40
    assert len(found["recording"]["losses"]) == 1
    assert "loss:" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--pose-topic", "/nope"], "no topic /nope of poses"),
        (["--image-topic", "/nope"], "no topic /nope"),
        (["--depth-topic", "/camera/camera_info"], "is sensor_msgs/msg/CameraInfo"),
        (["--model", "huge"], "model 'huge' is unknown"),
    ],
)
def test_what_cannot_be_used_is_named(
    recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    message: str,
) -> None:
    assert run(recording, tmp_path / "out", *options) == UNUSABLE
    assert message in capsys.readouterr().err


def two_cameras(path: Path, broken: bool = False) -> None:
    with RecordingWriter(path) as writer:
        for index, frame in enumerate(rgbd(3)):
            stamp = 1_000_000_000 + index
            writer.write_image("/left/image", frame.image, stamp, "left")
            writer.write_image("/right/image", frame.image[:, ::-1], stamp, "right")
            writer.write_camera_info("/right/camera_info", CAMERA, SIZE, stamp, "right")
            writer.write_depth("/right/depth", frame.depth_m[:, ::-1], stamp, "right")  # type: ignore[index]
            if broken:
                writer.write_cdr("/rear/image", IMAGE, b"\0\1\0\0abc", stamp)


def test_every_image_topic_is_a_stream_with_a_folder(tmp_path: Path) -> None:
    two_cameras(tmp_path / "walk")
    assert run(tmp_path / "walk", tmp_path / "out") == UNUSABLE  # which of them?
    assert run(tmp_path / "walk", tmp_path / "out", "--all-topics") == ALL
    left, right = (metrics(tmp_path / "out" / f"{side}_image") for side in ("left", "right"))
    assert left["recording"]["topics"] == {
        "image": "/left/image",
        "camera_info": "/right/camera_info",
        "depth": "/right/depth",
        "depth_info": None,
    }
    assert right["recording"]["topics"]["camera_info"] == "/right/camera_info"
    assert right["frames"] == left["frames"] == 3
    run(tmp_path / "walk", tmp_path / "alone", "--image-topic", "/right/image")
    assert metrics(tmp_path / "alone")["output_sha256"] == right["output_sha256"]
    assert left["output_sha256"] != right["output_sha256"]


def test_controls_of_the_latent_are_run_when_asked_for(recording: Path, tmp_path: Path) -> None:
    options = ("--write", "none", "--scene-cut-threshold", "0")
    assert run(recording, tmp_path / "plain", *options) == ALL
    assert run(recording, tmp_path / "out", *options, "--controls") == ALL
    plain, found = metrics(tmp_path / "plain"), metrics(tmp_path / "out")
    assert found["output_sha256"] == plain["output_sha256"]
    controls = found["controls"]
    assert list(controls) == ["ramp", "constant", "ema", "frozen"]
    assert {name: controls[name] for name in plain["controls"]} == plain["controls"]
    model = load_tiny()
    for name, stabilizer in latent_controls(model).items():
        scorer = SequenceScorer()
        with stabilized_by(model, stabilizer):
            stream = DepthStream(model, CAMERA)
            for frame in rgbd(5):
                truth = np.asarray(frame.depth_m, np.float32)
                predicted = as_array(stream.push(frame.image, frame.stamp))
                scorer.push(predicted, np.where(truth > 0, truth, np.nan))
        image, video = scorer.image(), scorer.video()
        assert image is not None and video is not None
        assert controls[name]["image"] == pytest.approx(image.metrics, rel=1e-6)
        assert controls[name]["video"] == pytest.approx(video.metrics, rel=1e-6)
    assert len({controls[name]["video"]["abs_rel"] for name in controls}) == 4
    assert controls["ema"]["video"] != found["video"] != controls["frozen"]["video"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "control: ema" in page and "moving average" in page
    assert "control: ema" not in (tmp_path / "plain" / "report.html").read_text()


@pytest.mark.parametrize("option", ["--controls", "--compare"])
def test_a_prediction_topic_runs_no_model(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    topic = ["walk", "--out", "out", "--prediction-topic", "/other/depth"]
    with pytest.raises(SystemExit):
        parse([*topic, option])
    assert f"{option} needs a model" in capsys.readouterr().err
    assert parse(topic).job.run == PredictionTopic("/other/depth")
    assert capsys.readouterr().err == ""
    parse([*topic, "--model", "tiny", "--no-stabilize"])
    assert "--model, --stabilize: no effect" in capsys.readouterr().err


def test_a_comparison_of_the_base_model_with_itself_is_refused(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        parse(["walk", "--out", "out", "--no-stabilize", "--compare"])
    assert "both runs are the same" in capsys.readouterr().err

    def base(name: str, device: str) -> Any:
        model = load_tiny()
        model.stabilizer = None
        return model

    command = [str(recording), "--out", str(tmp_path / "out"), "--model", "tiny", "--compare"]
    assert main([*command, "--write", "none"], base) == ALL
    assert "base" not in metrics(tmp_path / "out")
    assert "nothing to compare" in capsys.readouterr().err


def test_help_and_options_come_without_torch(tmp_path: Path) -> None:
    slow = "[m for m in ('torch', 'matplotlib', 'rosbags', 'scipy') if m in sys.modules]"
    code = f"import sys, dyfn_ros.replay.options, dyfn_ros.replay.cli; print({slow})"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=True
    )
    assert done.stdout.strip() == "[]"


def test_help_has_a_group_for_each_owner(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        parse(["--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    for group in ("source", "stream", "metric scale", "run", "outputs", "batch"):
        assert f"\n{group}:\n" in text


def drifting(truth: np.ndarray, index: int) -> np.ndarray:
    return (truth * 0.5 + 0.2) * 1.2**index


def other_method(
    path: Path, says: Callable[[np.ndarray, int], np.ndarray] = drifting
) -> list[FrameToRecord]:
    """A camera, its truth, and what another node says of it; that node missed the second."""
    frames = rgbd(4)
    with RecordingWriter(path) as writer:
        for index, frame in enumerate(frames):
            stamp = (1 + index) * 1_000_000_000
            truth = frame.depth_m
            assert truth is not None
            writer.write_image("/camera/image", frame.image, stamp, "camera")
            writer.write_camera_info("/camera/camera_info", CAMERA, SIZE, stamp, "camera")
            writer.write_depth("/camera/depth", truth, stamp, "camera")
            if index != 1:
                predicted = np.where(truth > 0, says(np.where(truth > 0, truth, 1), index), np.nan)
                writer.write_depth("/other/depth", predicted, stamp, "camera")
    return frames


def test_another_methods_topic_is_scored_as_it_stands(tmp_path: Path) -> None:
    frames = other_method(tmp_path / "walk")
    out = tmp_path / "out"
    topics = ("--depth-topic", "/camera/depth", "--prediction-topic", "/other/depth")
    assert run(tmp_path / "walk", out, *topics) == ALL
    found = metrics(out)
    assert (found["frames"], found["model"], found["stabilizer"]) == (4, "/other/depth", False)
    assert found["recording"]["warnings"] == {"/other/depth: no depth at an image's stamp": 1}
    scorer = SequenceScorer()
    for index, frame in enumerate(frames):
        truth = np.asarray(frame.depth_m)
        predicted = drifting(truth, index)
        known = (truth > 0) & (index != 1)
        scorer.push(np.where(known, predicted, np.nan), np.where(truth > 0, truth, np.nan))
    image, video = scorer.image(), scorer.video()
    assert image is not None and video is not None
    assert found["image"]["abs_rel"] == pytest.approx(image.metrics["abs_rel"], abs=1e-6)
    assert found["video"]["abs_rel"] == pytest.approx(video.metrics["abs_rel"], abs=1e-6)
    assert found["video"]["abs_rel"] > 0.05 > found["image"]["abs_rel"]
    assert "/other/depth" in (out / "report.html").read_text()


TOPICS = ("--depth-topic", "/camera/depth", "--prediction-topic", "/other/depth")


@pytest.mark.parametrize(
    ("quantity", "says"),
    [
        ("inverse", lambda truth, index: 3 / truth),
        ("disparity", lambda truth, index: 2 / truth + 0.7),
    ],
)
def test_another_methods_topic_may_hold_inverse_depth_or_disparity(
    quantity: str, says: Callable[[np.ndarray, int], np.ndarray], tmp_path: Path
) -> None:
    other_method(tmp_path / "walk", says)
    assert run(tmp_path / "walk", tmp_path / "out", *TOPICS, "--quantity", quantity) == ALL
    found = metrics(tmp_path / "out")
    assert found["quantity"] == ("disparity" if quantity == "disparity" else "depth")
    assert found["options"]["predicted"] == quantity
    assert found["video"]["abs_rel"] < 1e-5 and found["video"]["delta1"] == 1
    scale, shift = (1 / 2, -0.7 / 2) if quantity == "disparity" else (3, 0)
    assert found["alignment"] == pytest.approx({"scale": scale, "shift": shift}, abs=1e-4)
    assert run(tmp_path / "walk", tmp_path / "depth", *TOPICS) == ALL
    assert metrics(tmp_path / "depth")["video"]["abs_rel"] > 0.05


def rewrite(old: Path, new: Path, change: Callable[[Any], None]) -> None:
    """The same recording, but for what `change` does to the messages of /other/depth."""
    with RecordingWriter(new) as writer, Reader(old) as reader:
        for connection, stamp, data in reader.messages():
            message = TYPES.deserialize_cdr(data, connection.msgtype)
            if connection.topic == "/other/depth":
                change(message)
            writer.write(connection.topic, connection.msgtype, message, stamp)


def test_disparity_0_of_a_topic_is_far_away_and_of_depth_nothing(tmp_path: Path) -> None:
    def says(truth: np.ndarray, index: int) -> np.ndarray:
        return np.where(truth > 3, np.nan, 1 / truth - 1 / 3)

    def nothing_is_0(message: Any) -> None:
        message.data = np.nan_to_num(message.data.view(np.float32)).view(np.uint8)

    other_method(tmp_path / "nan", says)
    rewrite(tmp_path / "nan", tmp_path / "walk", nothing_is_0)
    coverage = {}
    for quantity in ("depth", "inverse", "disparity"):
        assert run(tmp_path / "walk", tmp_path / quantity, *TOPICS, "--quantity", quantity) == ALL
        coverage[quantity] = metrics(tmp_path / quantity)["coverage"]
    assert coverage["disparity"] == 1
    assert coverage["depth"] == coverage["inverse"] < 0.95


def test_disparity_of_another_camera_is_refused_and_inverse_depth_projected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = CAMERA * [[0.5], [0.5], [1]]  # sees twice as far to the sides
    with RecordingWriter(tmp_path / "walk") as writer:
        for stamp in (1_000_000_000, 2_000_000_000):
            writer.write_image("/camera/image", np.zeros((*SIZE, 3), np.uint8), stamp, "camera")
            writer.write_camera_info("/camera/camera_info", CAMERA, SIZE, stamp, "camera")
            writer.write_depth("/camera/depth", np.full(SIZE, 2.0), stamp, "camera")
            writer.write_camera_info("/other/camera_info", camera, SIZE, stamp, "camera")
            writer.write_depth("/other/depth", np.full(SIZE, 0.5), stamp, "camera")
    out = tmp_path / "out"
    assert run(tmp_path / "walk", out, *TOPICS, "--quantity", "inverse") == ALL
    assert metrics(out)["video"]["abs_rel"] < 1e-6
    capsys.readouterr()
    assert run(tmp_path / "walk", out, *TOPICS, "--quantity", "disparity") == UNUSABLE
    error = capsys.readouterr().err
    assert "/other/depth: no usable prediction: " in error and "cannot be projected" in error


def test_predictions_that_cannot_be_read_are_losses(tmp_path: Path) -> None:
    def broken(message: Any) -> None:
        if message.header.stamp.sec == 3:
            message.encoding = "8UC1"

    other_method(tmp_path / "walk")
    rewrite(tmp_path / "walk", tmp_path / "broken", broken)
    assert run(tmp_path / "broken", tmp_path / "out", *TOPICS) == PARTIAL
    (loss,) = metrics(tmp_path / "out")["recording"]["losses"]
    assert loss.startswith("/other/depth: depth skipped: ") and "8UC1" in loss


def test_a_prediction_is_not_scored_against_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other_method(tmp_path / "walk")
    itself = ("--prediction-topic", "/other/depth", "--depth-topic", "/other/depth")
    assert run(tmp_path / "walk", tmp_path / "out", *itself) == UNUSABLE
    assert "is the prediction and the ground truth" in capsys.readouterr().err
    folder = tmp_path / "folder"
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
        kind = np.uint8 if name == "rgb" else np.uint16
        cv2.imwrite(str(folder / name / "0.png"), np.full((8, 8), 100, kind))
    (folder / "K.txt").write_text("8 0 4\n0 8 4\n0 0 1\n")
    assert run(folder, tmp_path / "out", *itself[:2]) == UNUSABLE
    assert "expected a recording with a topic /other/depth" in capsys.readouterr().err


def test_a_quantity_needs_a_prediction_topic(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse(["walk", "--out", "out", "--quantity", "inverse"])
    assert "--quantity describes --prediction-topic" in capsys.readouterr().err


def test_a_prediction_topic_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other_method(tmp_path / "walk")
    topics = ("--depth-topic", "/camera/depth", "--prediction-topic", "/nobody")
    assert run(tmp_path / "walk", tmp_path / "out", *topics) == UNUSABLE
    assert "/nobody" in capsys.readouterr().err


def test_of_several_topics_one_that_fails_does_not_stop_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two_cameras(tmp_path / "walk", broken=True)
    several = [part for name in ("rear", "right") for part in ("--image-topic", f"/{name}/image")]
    assert run(tmp_path / "walk", tmp_path / "out", *several) == PARTIAL
    assert "no frame could be used" in capsys.readouterr().err
    assert metrics(tmp_path / "out" / "right_image")["frames"] == 3
    assert not (tmp_path / "out" / "rear_image" / "metrics.json").exists()


def test_a_result_says_on_how_many_threads(recording: Path, tmp_path: Path) -> None:
    before = torch.get_num_threads()
    main([str(recording), "--out", str(tmp_path / "out"), "--model", "tiny"], load_tiny)
    assert metrics(tmp_path / "out")["options"]["threads"] == THREADS
    assert torch.get_num_threads() == before
    torch.set_num_threads(3)
    main([str(recording), "--out", str(tmp_path / "other"), "--model", "tiny"], load_tiny)
    torch.set_num_threads(before)
    for name in ("options", "output_sha256"):
        assert metrics(tmp_path / "out")[name] == metrics(tmp_path / "other")[name]


@pytest.mark.parametrize("name", ["tiny", "dyfn-mini"])
def test_the_result_is_the_same_on_one_thread_and_on_several(tmp_path: Path, name: str) -> None:
    write_rgbd_recording(tmp_path / "walk", rgbd(2, truth=False))
    loader = load_tiny if name == "tiny" else load
    hashes = set()
    for threads in (1, 2, 3):
        options = ["--model", name, "--num-tokens", "24", "--no-output-recording"]
        options += ["--threads", str(threads), "--out", str(tmp_path / "out")]
        assert main([str(tmp_path / "walk"), *options], loader) == ALL
        assert metrics(tmp_path / "out")["options"]["threads"] == threads
        hashes.add(metrics(tmp_path / "out")["output_sha256"])
    assert len(hashes) == 1


def test_no_recording_is_exit_code_two(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path / "nowhere", tmp_path / "out") == UNUSABLE
    assert "nowhere does not exist" in capsys.readouterr().err


@pytest.mark.parametrize(
    "wrong",
    [
        ["--max-frames", "0"],
        ["--stride", "-1"],
        ["--depth-max", "0"],
        ["--out"],
        ["--write", "gif"],
    ],
)
def test_wrong_options_are_refused(wrong: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        parse(["walk", "--out", "out", *wrong])
    assert end.value.code == 2
    assert wrong[0] in capsys.readouterr().err
