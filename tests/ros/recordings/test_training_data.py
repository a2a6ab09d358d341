"""Recordings as training data: what is read, what is skipped, and a run on one."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

from dyfn_core.cli.train import main
from dyfn_core.data import datasets
from dyfn_core.data.datasets import data_kind, open_kind, open_posed
from dyfn_core.data.frames import DataError
from dyfn_core.data.pool import DataSpec, open_pool
from dyfn_core.models.checkpoints import load_model
from dyfn_ros.recordings.typestore import COMPRESSED_IMAGE, compressed_message
from dyfn_ros.recordings.writer import RecordingWriter
from tests.support.odometry import MOUNT, pose_text
from tests.support.plane_drive import OWN_CAMERA, drive
from tests.support.textured_plane import SIZE as PLANE_SIZE
from tests.support.textured_plane import pose_at

SIZE = (48, 64)
CAMERA = np.array([[50.0, 0, 30.5], [0, 52.0, 24.5], [0, 0, 1]])
PERIOD = 100_000_000  # ns
DEPTH = "/camera/depth/image"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DYFN_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def picture(index: int) -> np.ndarray:
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] / 8.0
    waves = [np.sin(x + index / 3 + k) + np.cos(y - k) for k in range(3)]
    return (np.stack(waves, -1) * 50 + 128).astype(np.uint8)


def metres(index: int) -> np.ndarray:
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    depth = 1 + 0.05 * x + 0.02 * y + 0.1 * index
    depth[:4] = np.nan
    return np.round(depth, 3)


Writer = Callable[[RecordingWriter, np.ndarray, int], None]


def as_16uc1(writer: RecordingWriter, depth: np.ndarray, stamp: int) -> None:
    writer.write_depth(DEPTH, depth, stamp, "camera", "16UC1")


def as_32fc1(writer: RecordingWriter, depth: np.ndarray, stamp: int) -> None:
    writer.write_depth(DEPTH, depth, stamp, "camera", "32FC1")


def as_compressed_depth(writer: RecordingWriter, depth: np.ndarray, stamp: int) -> None:
    millimetres = np.round(np.nan_to_num(depth) * 1000).astype(np.uint16)
    data = struct.pack("<iff", 0, 0, 0) + cv2.imencode(".png", millimetres)[1].tobytes()
    layout = "16UC1; compressedDepth png"
    message = compressed_message(np.frombuffer(data, np.uint8), layout, stamp, "camera")
    writer.write(f"{DEPTH}/compressedDepth", COMPRESSED_IMAGE, message, stamp)


def write_recording(
    path: Path,
    frames: int = 6,
    write_depth: Writer | None = as_16uc1,
    late: int = 0,
    without_depth: tuple[int, ...] = (),
    gap_before: int | None = None,
    info: bool = True,
) -> Path:
    """Frames 0.1 s apart (2 s before `gap_before`), their depth `late` ns after them."""
    with RecordingWriter(path) as writer:
        for index in range(frames):
            stamp = 1_000_000_000 + index * PERIOD
            if gap_before is not None and index >= gap_before:
                stamp += 2_000_000_000
            if info:
                writer.write_camera_info("/camera/camera_info", CAMERA, SIZE, stamp, "camera")
            writer.write_image("/camera/image", picture(index), stamp, "camera")
            if write_depth is not None and index not in without_depth:
                write_depth(writer, metres(index), stamp + late)
    return path


@pytest.mark.parametrize("write_depth", [as_16uc1, as_32fc1, as_compressed_depth])
@pytest.mark.parametrize("name", ["run.mcap", "run.db3", "bag"])
def test_frames_come_back_by_value(write_depth: Writer, name: str, tmp_path: Path) -> None:
    path = write_recording(tmp_path / name, 3, write_depth, late=15_000_000)
    pool = open_pool((DataSpec(path),), "train", 3)
    (sequence,) = pool.sequences
    for index in range(3):
        frame = sequence.read(index)
        np.testing.assert_allclose(frame.depth, metres(index), rtol=6e-4)
        assert np.isnan(frame.depth[:4]).all()
        assert np.abs(frame.image.astype(int) - picture(index)).mean() < 6
        np.testing.assert_allclose(frame.intrinsics, [50 / 64, 52 / 48, 31 / 64, 25 / 48])


def test_depth_beyond_the_tolerance_is_no_depth(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", late=30_000_000)
    nothing_near = r"^recording at .*6 x image without depth within 0.02 s \(`tolerance`\)"
    with pytest.raises(DataError, match=nothing_near):
        open_kind("recording", path, {})
    (sequence,), report = open_kind("recording", path, {"tolerance": 0.04})
    assert len(sequence) == 6
    assert not report.problems


def test_frames_without_depth_are_counted_and_a_gap_in_time_is_a_cut(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", 9, without_depth=(1,), gap_before=5)
    sequences, report = open_kind("recording", path, {})
    assert [list(s.numbers) for s in sequences] == [[0, 2, 3, 4], [5, 6, 7, 8]]  # type: ignore[attr-defined]
    assert "1 x image without depth within 0.02 s (`tolerance`) of its stamp" in report.summary()
    assert len(open_kind("recording", path, {"max_gap": 0.15})[0]) == 3
    assert len(open_kind("recording", path, {"max_gap": 3.0})[0]) == 1


def test_recording_without_intrinsics_can_be_told_them(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", info=False)
    with pytest.raises(DataError, match=r"6 x image without usable CameraInfo \(or give `intrin"):
        open_kind("recording", path, {})
    (sequence,), _ = open_kind("recording", path, {"intrinsics": (50.0, 52.0, 30.5, 24.5)})
    np.testing.assert_allclose(sequence.read(0).intrinsics[2:], [31 / 64, 25 / 48])


def test_recording_without_depth_topic_or_of_nothing_is_refused(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", write_depth=None)
    with pytest.raises(DataError, match=r"no depth topic to train on; it holds /camera/camera_inf"):
        open_kind("recording", path, {})
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(DataError, match=r"empty\.mcap is empty"):
        open_kind("recording", tmp_path / "empty.mcap", {})
    with pytest.raises(DataError, match="no topic /no, expected one of"):
        open_kind("recording", path, {"depth_topic": "/no"})


def test_large_frames_are_shrunk_and_pictures_are_written_once(tmp_path: Path, cache: Path) -> None:
    path = write_recording(tmp_path / "run.mcap")
    options = {"max_side": 32}
    (sequence,), _ = open_kind("recording", path, options)
    frame = sequence.read(2)
    assert frame.image.shape == (24, 32, 3)
    np.testing.assert_allclose(frame.intrinsics, [50 / 64, 52 / 48, 31 / 64, 25 / 48])
    (folder,) = (cache / "recordings").iterdir()
    before = {file.name: file.stat().st_mtime_ns for file in folder.iterdir()}
    open_kind("recording", path, options)
    assert before == {file.name: file.stat().st_mtime_ns for file in folder.iterdir()}
    open_kind("recording", path, {})
    assert len(list((cache / "recordings").iterdir())) == 2


def test_a_truncated_recording_is_used_up_to_the_damage_and_says_so(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", 120)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    sequences, report = open_kind("recording", path, {})
    assert 0 < sum(map(len, sequences)) < 120
    assert "the rest is damaged or missing" in report.summary()


def test_without_the_reading_libraries_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken:
        name, value = "recording", "dyfn_ros.recordings.training_data:RECORDING"

        def load(self) -> object:
            raise ImportError("No module named 'rosbags'")

    monkeypatch.setattr(datasets, "entry_points", lambda group: [Broken()])
    datasets.data_kinds.cache_clear()
    try:
        with pytest.raises(DataError, match=r"No module named 'rosbags'; `pip install rosbags"):
            data_kind("recording")
        path = write_recording(tmp_path / "run.mcap", 2)
        with pytest.raises(DataError, match=r"not available: recording \(dyfn_ros cannot be"):
            open_pool((DataSpec(path),), "train")
    finally:
        datasets.data_kinds.cache_clear()


TINY = {
    "stages": [{"from_step": 0, "batch": 2, "sizes": [[32, 64]]}],
    "steps": 2,
    "threads": 1,
    "log_every": 1,
    "picture_every": 2,
    "validate_every": 2,
    "warmup_steps": 1,
    "method.cache_draws": 2,
    "method.cache_length": 4,
    "method.strides": [1, 2],
    "method.clips": 2,
    "method.length": 3,
    "method.objective.decoded": 3,
    "method.objective.windows": [1],
    "validation_clips": 1,
}


def test_fine_tuning_on_a_recording_changes_dyfn_alone(tmp_path: Path) -> None:
    """`dyfn-train dyfn --data recording.mcap --data folder`, with the default config."""
    path = write_recording(tmp_path / "run.mcap", 8)
    folder = tmp_path / "folder"
    for index in range(8):
        for name, pixels in (("rgb", picture(index)), ("depth", metres(index))):
            (folder / name).mkdir(parents=True, exist_ok=True)
            values = pixels if name == "rgb" else np.nan_to_num(pixels * 1000).astype(np.uint16)
            cv2.imwrite(str(folder / name / f"{index}.png"), values)
    np.savetxt(folder / "K.txt", CAMERA)
    settings = [
        text for key, value in TINY.items() for text in ("--set", f"{key}={json.dumps(value)}")
    ]
    data = ["--data", str(path), "--data", str(folder)]
    assert main(["dyfn", *data, "--out", str(tmp_path / "out"), *settings]) == 0
    before = load_model("dyfn-mini").state_dict()
    after = load_model(tmp_path / "out" / "model.safetensors").state_dict()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed
    assert all(name.startswith("stabilizer.") for name in changed)


def test_recording_given_with_options_on_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_recording(tmp_path / "run.mcap", 8, late=30_000_000)
    settings = [
        text for key, value in TINY.items() for text in ("--set", f"{key}={json.dumps(value)}")
    ]
    out = tmp_path / "out"
    command = ["dyfn", "--out", str(out), *settings, "--data"]
    assert main([*command, str(path)]) == 1
    told = capsys.readouterr().err
    assert "8 x image without depth within 0.02 s (`tolerance`)" in told
    assert main([*command, f"{{root: {path}, kind: recording, tolerance: 0.04}}"]) == 0
    assert f"step 2: {out / 'model.safetensors'}" in capsys.readouterr().out
    assert main([*command, "{root: [}"]) == 1
    assert "--data '{root: [}' is no YAML" in capsys.readouterr().err


def test_a_recording_without_any_valid_depth_is_trained_on_but_not_scored(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def unknown(writer: RecordingWriter, depth: np.ndarray, stamp: int) -> None:
        as_16uc1(writer, np.full_like(depth, np.nan), stamp)

    path = write_recording(tmp_path / "run.mcap", 8, unknown)
    settings = [
        text for key, value in TINY.items() for text in ("--set", f"{key}={json.dumps(value)}")
    ]
    out = tmp_path / "out"
    assert main(["dyfn", "--data", str(path), "--out", str(out), *settings]) == 0
    assert "no depth is known in the validation clips" in caplog.text
    results = json.loads((out / "results.json").read_text())
    assert results["score"] is None
    assert (out / "model.safetensors").exists()


def test_recording_named_in_a_config_with_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_recording(tmp_path / "run.mcap", 8)
    named = {"root": str(path), "kind": "recording", "depth_topik": DEPTH}
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump({**TINY, "base": "dyfn-mini", "data": [named]}))
    assert main(["dyfn", str(config), "--out", str(tmp_path / "out")]) == 1
    assert (
        "'depth_topik' of kind 'recording', did you mean 'depth_topic'" in capsys.readouterr().err
    )


def walked(tmp_path: Path, frames: int = 6) -> tuple[Path, list[np.ndarray]]:
    """A folder of flat pictures, and the camera's poses in it.

    The base goes straight on and turns, each at one speed, so that a pose between two others is
    exactly the interpolated one.
    """
    folder = tmp_path / "walk"
    bases = [pose_at((0.04 * i, 0.01 * i, 0), (0, 0, 0.03 * i)) for i in range(frames)]
    poses = [base @ MOUNT for base in bases]
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    np.savetxt(folder / "K.txt", OWN_CAMERA)
    np.savetxt(folder / "poses.txt", np.stack(poses).reshape(-1, 16))
    for index in range(frames):
        cv2.imwrite(
            str(folder / f"rgb/{index}.png"), np.full((*PLANE_SIZE, 3), 9 * index, np.uint8)
        )
        depth = np.full(PLANE_SIZE, 1000 + index, np.uint16)
        cv2.imwrite(str(folder / f"depth/{index}.png"), depth)
    return folder, poses


def test_a_bag_with_odometry_gives_the_cameras_poses_in_order(tmp_path: Path) -> None:
    """The base's odometry comes between the images; its growth and the depth come along."""
    folder, poses = walked(tmp_path)
    bag, place = drive(folder, tmp_path / "bag" / "drive.mcap"), {"camera_pose": pose_text(MOUNT)}
    (recording,) = open_posed(bag, "auto", place)
    frames = list(recording.frames())
    assert recording.expected == len(frames) == len(poses)
    for found, pose in zip(frames[1:-1], poses[1:-1], strict=True):  # odometry on either side
        np.testing.assert_allclose(found.pose, pose, atol=1e-9)
    for index, frame in enumerate(frames):
        assert frame.image[0, 0, 0] == 9 * index and frame.depth is not None
        assert frame.depth[0, 0] == pytest.approx(1 + index / 1000)
        np.testing.assert_allclose(frame.camera_matrix, OWN_CAMERA)
    assert np.diff([frame.stamp for frame in frames]) == pytest.approx(0.1)
    (unplaced,) = open_posed(bag, "auto", {})
    assert all(frame.pose is None for frame in unplaced.frames())
    assert any("'base_link'" in text and "camera_pose" in text for text in unplaced.problems)


def test_a_bag_without_usable_odometry_is_refused_before_it_is_read(tmp_path: Path) -> None:
    folder, _ = walked(tmp_path)
    bag = drive(folder, tmp_path / "bag" / "drive.mcap")
    with pytest.raises(DataError, match=r"no topic /nothing of poses, odometry or TF"):
        open_posed(bag, "recording", {"odometry_topic": "/nothing"})
    with pytest.raises(DataError, match="camera_pose"):
        open_posed(bag, "recording", {"camera_pose": "1 2 3"})
    with pytest.raises(DataError, match="recording has no option 'odometry'"):
        open_posed(bag, "recording", {"odometry": "/odom"})
    plain = tmp_path / "plain.mcap"
    with RecordingWriter(plain) as writer:
        writer.write_png("/camera/image", picture(0), 10**9, "camera")
        writer.write_camera_info("/camera/camera_info", CAMERA, SIZE, 10**9, "camera")
    with pytest.raises(DataError, match="expected a topic of poses, odometry or TF"):
        open_posed(plain, "auto", {})
