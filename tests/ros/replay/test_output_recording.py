"""output.mcap as a recording: scored again to the same numbers, standing in the world, small."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from dyfn_ros.messages.compressed_depth import (
    PRECISION,
    RATIO,
    decode_compressed_depth,
    encode_depth_range,
)
from dyfn_ros.messages.references import decode_points
from dyfn_ros.recordings.open import open_recording
from dyfn_ros.recordings.poses import open_poses
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording
from dyfn_ros.recordings.storage.open import open_storage
from dyfn_ros.recordings.typestore import TYPES, Lens, compressed_message
from dyfn_ros.recordings.writer import RecordingWriter
from dyfn_ros.replay.cli import main
from dyfn_ros.replay.jobs import ALL
from tests.support import views
from tests.support.tiny_model import load_tiny
from tests.support.wall_walk import CAMERA, SIZE, WALL, camera_pose

DEMO = Path(__file__).parents[3] / "bags" / "demo"
PREDICTION, TRUTH = "/stream_depth/depth/image", "/camera/ground_truth/image"


def walk(count: int = 6, lens: Lens | None = None) -> list[FrameToRecord]:
    """Frames of a wall, a step in it, seen from poses that are known."""
    rng = np.random.default_rng(5)
    picture = cv2.resize(rng.integers(0, 255, (6, 8, 3), np.uint8), SIZE[::-1])
    frames = []
    for index in range(count):
        depth = np.full(SIZE, WALL - 0.3 * index) * rng.uniform(0.8, 1.2, SIZE)
        depth[:, :20] *= 0.6
        image = np.roll(picture, 3 * index, axis=1)
        stamp = 1.7e9 + index / 10
        frames.append(FrameToRecord(image, depth, CAMERA, camera_pose(index), stamp, lens))
    return frames


def replay(recording: Path, out: Path, *options: str) -> dict[str, Any]:
    fixed = ["--out", str(out), "--model", "tiny", "--threads", "1"]
    if "--prediction-topic" in options:
        fixed = ["--out", str(out)]
    assert main([str(recording), *fixed, *options], load_tiny) == ALL
    found: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    return found


def read(path: Path) -> dict[str, list[tuple[int, Any]]]:
    found: dict[str, list[tuple[int, Any]]] = {}
    with Reader(path) as reader:
        for connection, time, data in reader.messages():
            message = TYPES.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((time, message))
    return found


@pytest.mark.parametrize("ratio", [1.0, 1.5, 13.0, 65.0, 400.0])
def test_depth_of_any_range_keeps_its_pixels_and_a_stated_error(ratio: float) -> None:
    rng = np.random.default_rng(0)
    depth = np.exp(rng.uniform(0, np.log(ratio), (60, 80))).astype(np.float32) * 0.037
    depth[0, 0], depth[0, 1] = 0.037, 0.037 * ratio
    valid = rng.uniform(size=depth.shape) > 0.2
    valid[0, :2] = True
    layout, data, stated = encode_depth_range(np.where(valid, depth, np.nan), valid)
    message = compressed_message(np.frombuffer(data, np.uint8), layout, 0, "c")
    found = decode_compressed_depth(message)
    np.testing.assert_array_equal(np.isfinite(found), valid)
    errors = np.abs(found[valid] / depth[valid] - 1)
    assert errors.max() <= stated * 1.01 + 1e-6
    assert stated <= PRECISION * 1.01 or ratio > RATIO
    assert stated == pytest.approx(max(PRECISION, ratio / 131_068), rel=0.02)


@pytest.mark.parametrize("lens", [None, Lens("plumb_bob", (-0.2, 0.05, 0.0, 0.0, 0.0))])
@pytest.mark.parametrize("form", ["mcap", "raw"])
def test_the_output_is_scored_again_to_the_same_numbers(
    tmp_path: Path, lens: Lens | None, form: str
) -> None:
    frames = walk(lens=lens)
    write_rgbd_recording(tmp_path / "walk", frames, depth_encoding="32FC1")
    first = replay(tmp_path / "walk", tmp_path / "out", "--write", form)
    output = tmp_path / "out" / "output.mcap"
    topics = ("--prediction-topic", PREDICTION, "--depth-topic", TRUTH)
    again = replay(output, tmp_path / "again", *topics)
    assert again["frames"] == first["frames"] == len(frames)
    assert again["recording"]["losses"] == again["recording"]["warnings"] == {}
    # A model that knows nothing gives depth that is nearly flat, so that its fits are loose.
    near = 1e-6 if form == "raw" else 5e-3
    for protocol in ("image", "video"):
        for name in ("abs_rel", "delta1"):
            assert again[protocol][name] == pytest.approx(first[protocol][name], abs=near)
    assert again["coverage"] == pytest.approx(first["coverage"], abs=1e-6)
    # The model runs on it as well, with the truth that is beside the image.
    assert open_recording(output).topics.depth in (TRUTH, f"{TRUTH}/compressedDepth")


def test_the_clouds_stand_in_the_world_at_the_times_of_the_input(tmp_path: Path) -> None:
    frames = walk()
    late = 250_000_000  # recorded later than it was taken
    with RecordingWriter(tmp_path / "walk") as writer:
        for frame in frames:
            stamp = frame.stamp_ns
            writer.write_jpeg(
                "/camera/image/compressed", frame.image, stamp, "optical", log_ns=stamp + late
            )
            writer.write_camera_info("/camera/camera_info", CAMERA, SIZE, stamp, "optical")
            writer.write_depth("/camera/depth/image", frame.depth_m, stamp, "optical")
            writer.write_transform(frame.pose, stamp, "map", "optical")
    replay(tmp_path / "walk", tmp_path / "out", "--write", "mcap")
    found = read(tmp_path / "out" / "output.mcap")
    stamps = [frame.stamp_ns for frame in frames]
    for topic in ("/stream_depth/points", f"{PREDICTION}/compressedDepth", "/stream_depth/scale"):
        assert [time for time, _ in found[topic]] == [stamp + late for stamp in stamps], topic
    heads = [message.header for _, message in found["/stream_depth/points"]]
    assert [h.stamp.sec * 1_000_000_000 + h.stamp.nanosec for h in heads] == stamps
    transforms = [message.transforms[0] for _, message in found["/tf"]]
    assert {(t.header.frame_id, t.child_frame_id) for t in transforms} == {("world", "optical")}
    assert {head.frame_id for head in heads} == {"optical"}
    where = open_poses(tmp_path / "out" / "output.mcap", "optical")
    for index, frame in enumerate(frames):
        pose = where(index, frame.stamp_ns)
        np.testing.assert_allclose(pose, frame.pose, atol=1e-6)  # type: ignore[arg-type]
    assert len(found["/stream_depth/pose"]) == len(frames)


def test_clouds_are_in_metres_of_the_world(tmp_path: Path) -> None:
    """The prediction, aligned, of one flat wall: its points lie on it in every frame."""
    from dyfn_core.scoring.frame_scores import FrameScore
    from dyfn_ros.replay.outputs import ReplayOutputs
    from dyfn_ros.replay.settings import Outputs
    from dyfn_ros.replay.shown_run import Alignment, ShownRun
    from tests.ros.replay.test_replay_outputs import facing_a_wall, perfect_up_to

    write_rgbd_recording(tmp_path / "walk", facing_a_wall(5), jpeg_quality=None)
    (tmp_path / "out").mkdir()
    chosen = Outputs(tmp_path / "out", write=("mcap",))
    with ReplayOutputs(chosen, tmp_path / "walk", 3, lambda text: pytest.fail(text)) as outputs:
        for frame in open_recording(tmp_path / "walk").frames():
            depth = WALL - 0.3 * frame.index + np.zeros(SIZE)
            pose = perfect_up_to(2.5, depth)
            outputs.write(frame, pose, FrameScore(1.0, 10))
        alignment = Alignment(2.5, 0.0, metres=True)
        outputs.finish([ShownRun("with DyFN", alignment, np.ones(5))])
    found = read(tmp_path / "out" / "output.mcap")
    for index, (_, message) in enumerate(found["/stream_depth/points"]):
        points = decode_points(message)
        assert len(points) > 500
        world = points @ camera_pose(index)[:3, :3].T + camera_pose(index)[:3, 3]
        np.testing.assert_allclose(world[:, 2], WALL, atol=1e-3)
    layout = json.loads((tmp_path / "out" / "output.foxglove.json").read_text())
    panels = layout["configById"]
    images = [p["imageMode"]["imageTopic"] for n, p in panels.items() if n.startswith("Image!")]
    topics = {*images, *panels["3D!world"]["topics"]}
    topics |= {path["value"].rsplit(".", 1)[0] for path in panels["Plot!scale"]["paths"]}
    assert topics - {"/stream_depth/scale", "/stream_depth/abs_rel"} <= {*found}
    assert panels["3D!world"]["followTf"] == "world"
    assert "to 4" in panels["Image!depth"]["foxglovePanelTitle"]


@pytest.mark.parametrize("form", ["mcap", "raw"])
def test_what_rviz_and_foxglove_show_is_in_the_file(tmp_path: Path, form: str) -> None:
    with RecordingWriter(tmp_path / "walk") as writer:
        for frame in walk(3):
            stamp = frame.stamp_ns
            writer.write_jpeg("/camera/image_raw/compressed", frame.image, stamp, "optical")
            writer.write_camera_info("/camera/camera_info", CAMERA, SIZE, stamp, "optical")
            writer.write_depth("/camera/depth/image", frame.depth_m, stamp, "optical")
            writer.write_transform(frame.pose, stamp, "map", "optical")
    replay(tmp_path / "walk", tmp_path / "out", "--write", form)
    topics = open_storage(tmp_path / "out" / "output.mcap").topics
    shown = list(views.of_foxglove(tmp_path / "out" / "output.foxglove.json"))
    if form == "mcap":
        shown += views.of_rviz(views.CONFIG / "replay.rviz")
        assert topics["/tf"].count == 3
    else:  # as the node publishes it
        live = views.of_rviz(views.CONFIG / "stream_depth.rviz")
        shown += [one for one in live if one.topic.startswith("/stream_depth/")]
    for one in shown:
        assert topics[one.topic].kind == one.kind, one
        assert one.fixed is not False, one


def enlarged(count: int) -> list[FrameToRecord]:
    """Frames of the demo at 540 x 360."""
    found = []
    for frame in islice(open_recording(DEMO).frames(), count):
        assert frame.depth is not None and frame.camera_matrix is not None
        height, width = frame.image.shape[:2]
        image = cv2.resize(frame.image, (540, 360), interpolation=cv2.INTER_CUBIC)
        depth = cv2.resize(frame.depth, (540, 360), interpolation=cv2.INTER_NEAREST)
        camera = np.diag([540 / width, 360 / height, 1.0]) @ frame.camera_matrix
        pose = camera_pose(frame.index)
        found.append(FrameToRecord(image, depth, camera, pose, frame.stamp_ns / 1e9))
    return found


def test_frames_of_540x360_are_small_and_scored_again_to_the_printed_digits(
    tmp_path: Path,
) -> None:
    write_rgbd_recording(tmp_path / "walk", enlarged(6))
    command = [str(tmp_path / "walk"), "--out", str(tmp_path / "out"), "--threads", "1"]
    assert main([*command, "--write", "mcap"]) == ALL
    output = tmp_path / "out" / "output.mcap"
    again = replay(output, tmp_path / "again", "--prediction-topic", PREDICTION)
    first = json.loads((tmp_path / "out" / "metrics.json").read_text())
    for protocol in ("image", "video"):
        for name in ("abs_rel", "delta1"):
            assert again[protocol][name] == pytest.approx(first[protocol][name], abs=2e-4)
    print(f"{output.stat().st_size / 6 / 1e6:.3f} MB a frame")
    assert output.stat().st_size / 6 < 300_000
    found = open_storage(output).topics
    for topic in ("/stream_depth/points", "/tf", f"{TRUTH}/compressedDepth"):
        assert found[topic].count == 6
