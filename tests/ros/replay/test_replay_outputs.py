"""Cloud, video and Rerun recording of a replay, by value; poses; disks that are full."""

import json
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from dyfn_core.geometry.camera import normalize_intrinsics
from dyfn_core.geometry.voxel_grid import VoxelGrid
from dyfn_core.prediction import Prediction
from dyfn_ros.recordings.open import open_recording
from dyfn_ros.recordings.poses import PoseError, open_poses
from dyfn_ros.recordings.rgbd_writer import FrameToRecord
from dyfn_ros.recordings.rgbd_writer import write_rgbd_recording as record
from dyfn_ros.recordings.typestore import TYPES, header
from dyfn_ros.recordings.writer import RecordingWriter
from dyfn_ros.replay.cli import main
from dyfn_ros.replay.jobs import ALL, UNUSABLE
from dyfn_ros.replay.outputs import ReplayOutputs
from dyfn_ros.replay.rerun import ROOM
from dyfn_ros.replay.settings import FILES, Outputs
from dyfn_ros.replay.shown_run import Alignment, ShownRun
from tests.support.tiny_model import load_tiny
from tests.support.wall_walk import CAMERA, SIZE, WALL, camera_pose


def facing_a_wall(count: int, poses: bool = True, truth: bool = True) -> list[FrameToRecord]:
    """Frames of a wall whose colour is green; true depth is the distance to it."""
    image = np.full((*SIZE, 3), (10, 200, 30), np.uint8)
    found = []
    for index in range(count):
        depth = np.full(SIZE, WALL - 0.3 * index)
        where = camera_pose(index) if poses else None
        found.append(FrameToRecord(image, depth if truth else None, CAMERA, where, 50 + index / 10))
    return found


def perfect_up_to(scale: float, depth: np.ndarray) -> Prediction[np.ndarray]:
    """What a model would predict that is right up to this scale."""
    predicted = (depth / scale).astype(np.float32)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    points = np.stack(
        [(u - 23.5) / 40 * predicted, (v - 17.5) / 40 * predicted, predicted], axis=-1
    )
    normalised = normalize_intrinsics(CAMERA, predicted.shape)
    return Prediction(points, predicted, np.isfinite(predicted), normalised, known_camera=CAMERA)


@pytest.fixture
def written(tmp_path: Path) -> Callable[..., list[str]]:
    """Plays a recording through ReplayOutputs with a perfect model; gives the warnings."""

    def write(frames: list[FrameToRecord], aligned: bool = True, **options: Any) -> list[str]:
        from dyfn_core.scoring.protocols import FrameScore

        record(tmp_path / "walk", frames, jpeg_quality=None, overwrite=True)
        (tmp_path / "out").mkdir(exist_ok=True)
        warnings: list[str] = []
        chosen = Outputs(tmp_path / "out", **options)
        with ReplayOutputs(chosen, tmp_path / "walk", 3, warnings.append) as outputs:
            for frame in open_recording(tmp_path / "walk").frames():
                depth = WALL - 0.3 * frame.index + np.zeros(SIZE)
                outputs.write(frame, perfect_up_to(2.5, depth), FrameScore(1.0, 10))
            alignment = Alignment(2.5, 0.0, metres=True) if aligned else Alignment()
            outputs.finish([ShownRun("with DyFN", alignment, np.ones(len(frames)))])
        return warnings

    return write


def test_the_cloud_is_where_the_world_is(tmp_path: Path, written: Callable[..., list[str]]) -> None:
    assert written(facing_a_wall(6), write=("ply",), voxel=0.05) == []
    content = (tmp_path / "out" / "cloud.ply").read_bytes()
    assert content.startswith(b"ply\nformat binary_little_endian 1.0\n")
    cloud = trimesh.load(tmp_path / "out" / "cloud.ply")
    points, colours = np.asarray(cloud.vertices), np.asarray(cloud.colors)
    np.testing.assert_allclose(points[:, 2], WALL, atol=1e-3)  # depth was stored in millimetres
    assert (colours[:, :3] == (10, 200, 30)).all()
    cells = np.floor(points[:, :2] / 0.05)
    assert len(np.unique(cells, axis=0)) == len(points)  # one point a voxel
    first = (np.array([[0, 0], [47, 35]]) - [23.5, 17.5]) / 40 * WALL
    assert points[:, 0].min() <= first[0, 0] + 0.05 and points[:, 1].max() >= first[1, 1] - 0.05
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["cloud.ply"]


def test_no_cloud_is_invented(tmp_path: Path, written: Callable[..., list[str]]) -> None:
    written(facing_a_wall(2), write=("ply",))
    assert (tmp_path / "out" / "cloud.ply").exists()
    (warning,) = written(facing_a_wall(2, poses=False), write=("ply",))
    assert "no cloud.ply" in warning and "no pose or odometry topic" in warning
    assert not (tmp_path / "out" / "cloud.ply").exists()  # that of the run before is gone
    (warning,) = written(facing_a_wall(2), aligned=False, write=("ply",))
    assert "no ground truth gives its metres" in warning
    (warning,) = written(facing_a_wall(2), write=("ply",), depth_max=1.0)
    assert "gave no point" in warning
    assert list((tmp_path / "out").iterdir()) == []


def test_metrics_say_why_there_is_no_cloud(tmp_path: Path) -> None:
    record(tmp_path / "walk", facing_a_wall(2, poses=False))
    arguments = [str(tmp_path / "walk"), "--out", str(tmp_path / "out"), "--model", "tiny"]
    assert main([*arguments, "--write", "ply"], load_tiny) == ALL
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert any("no cloud.ply" in one for one in found["recording"]["warnings"])


def test_a_cloud_of_any_length_stays_bounded() -> None:
    rng = np.random.default_rng(0)
    grid = VoxelGrid(0.01, max_voxels=2000)
    points = rng.uniform(-1, 1, (60_000, 3))
    points[0] = 1e9
    for part in np.array_split(points, 7):
        grid.add(part, np.full((len(part), 3), 50, np.uint8))
    found, colours = grid.cloud()
    assert len(found) <= 2000 and grid.size == 0.32 and grid.outside == 1
    cells, place = np.unique(np.floor(points[1:] / 0.32), axis=0, return_inverse=True)
    means = np.stack([np.bincount(place, p) / np.bincount(place) for p in points[1:].T], axis=1)
    assert len(found) == len(cells)
    order, other = np.lexsort(found.T.round(3)), np.lexsort(means.T.round(3))
    np.testing.assert_allclose(found[order], means[other], atol=1e-5)
    assert (colours == 50).all()


def test_the_video_plays_at_the_pace_of_the_stamps(
    tmp_path: Path, written: Callable[..., list[str]]
) -> None:
    frames = facing_a_wall(5)
    frames[4] = FrameToRecord(frames[4].image, frames[4].depth_m, CAMERA, None, 75.0)
    written(frames, write=("video",))
    with av.open(str(tmp_path / "out" / "video.mp4")) as video:
        assert video.streams.video[0].codec_context.name == "h264"
        shown = list(video.decode(video=0))
    assert [f.time for f in shown] == pytest.approx([0, 0.1, 0.2, 0.3, 1.3], abs=2e-3)
    pictures = [f.to_ndarray(format="rgb24") for f in shown]
    assert pictures[0].shape == (2 * (24 + 36) + 44, 3 * 48, 3)  # captions, panels, colour bars
    truths, middles = (
        [p[29:55, left + 5 : left + 43].mean((0, 1)) for p in pictures] for left in (48, 96)
    )
    np.testing.assert_allclose(truths, middles, atol=3)
    green = [p[29:55, 5:43].mean((0, 1)) for p in pictures]
    np.testing.assert_allclose(green, np.tile([10, 200, 30], (5, 1)), atol=8)
    assert np.abs(np.diff(middles, axis=0)).max(1).min() > 5  # nearer is redder, frame by frame
    assert middles[-1][0] > middles[0][0] and middles[-1][2] < middles[0][2]
    assert all(p[89:115, 101:139].mean() < 12 for p in pictures)  # no error: black


def test_flicker_is_seen_in_the_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same scene, 30 % farther, is painted in another colour: the range does not follow."""
    from dyfn_ros.replay import frame_spool
    from dyfn_ros.replay import video as replay_video

    spool = frame_spool.FrameSpool(tmp_path)
    record(tmp_path / "walk", facing_a_wall(1, truth=False))
    frame = next(open_recording(tmp_path / "walk").frames())
    ramp = np.tile(np.linspace(1, 5, SIZE[1]), (SIZE[0], 1))
    for scale in (1.0, 1.3, 1.0):
        spool.push(frame, perfect_up_to(1 / scale, ramp), None)
    run = ShownRun("base model", Alignment(), np.full(3, np.nan))
    panels = replay_video._Panels(spool, [run])
    first, second, third = (panels.draw(i, small)[24:60, 48:] for i, small in enumerate(spool))
    np.testing.assert_array_equal(first, third)
    assert np.abs(first.astype(int) - second).mean() > 10


def test_base_and_result_share_the_colours_of_the_video_and_the_report(tmp_path: Path) -> None:
    """Two runs in units of their own look like the truth; one that drifts does not."""
    from dyfn_ros.replay import cloud, frame_spool
    from dyfn_ros.replay import video as replay_video

    spool = frame_spool.FrameSpool(tmp_path)
    record(tmp_path / "walk", facing_a_wall(3))
    for frame in open_recording(tmp_path / "walk").frames():
        assert frame.depth is not None
        spool.push(frame, perfect_up_to(2.5, frame.depth), camera_pose(frame.index))
    for frame in open_recording(tmp_path / "walk").frames():
        assert frame.depth is not None
        spool.push_base(perfect_up_to(7.0 + frame.index, frame.depth))
    runs = [
        ShownRun("with DyFN", Alignment(2.5, metres=True), np.ones(3)),
        ShownRun("base model", Alignment(7.0, metres=True), np.array([1.0, 8 / 7, 9 / 7])),
    ]
    panels = replay_video._Panels(spool, runs)
    drawn = [panels.draw(i, small).astype(int) for i, small in enumerate(spool)]
    assert drawn[0].shape == (2 * (24 + 36) + 44, 4 * 48, 3)
    truth, base, result = (
        np.array([p[24:60, left : left + 48] for p in drawn]) for left in (48, 96, 144)
    )
    np.testing.assert_array_equal(truth, result)
    np.testing.assert_array_equal(truth[0], base[0])
    assert np.abs(truth[2] - base[2]).mean() > 5  # the base has drifted
    error = [np.abs(p[84:120, left : left + 48]).mean() for p in drawn[2:] for left in (96, 144)]
    assert error[0] > 5 * error[1]
    curve = [(p[60:120, :96] != drawn[0][60:120, :96]).sum() for p in drawn]
    assert 0 == curve[0] < curve[1] < curve[2]  # it runs on
    view = cloud.cloud_view(spool, None, runs, 0.05, np.inf)
    assert view is not None and [*view.clouds] == ["with DyFN", "base model", "ground truth"]
    middle = {name: np.median(one.points[:, 2]) for name, one in view.clouds.items()}
    assert middle["with DyFN"] == pytest.approx(middle["ground truth"])
    assert middle["base model"] == pytest.approx(middle["ground truth"] * 7 / 8)


def test_the_curve_of_the_video_has_the_drift_of_the_metrics() -> None:
    from dyfn_core.evaluation.sequence import SequenceEvaluation
    from dyfn_ros.replay.run import _shown

    rng = np.random.default_rng(3)
    evaluation = SequenceEvaluation(6)
    for index in range(6):
        truth = rng.uniform(1, 4, SIZE).astype(np.float32)
        depth = (truth * (1 + 0.1 * index) + 0.2).astype(np.float32)
        valid = np.ones(SIZE, bool)
        target = None if index == 2 else truth
        image = np.zeros((*SIZE, 3), np.uint8)
        evaluation.push(image, depth, valid, target, stamp=index / 10, latency=0.1)
    ratios = _shown("run", evaluation, None).ratios
    assert np.isnan(ratios[2]) and np.isfinite(np.delete(ratios, 2)).all()
    drift = evaluation.results()["drift"]["log_std"]
    assert np.std(np.log(np.delete(ratios, 2))) == pytest.approx(drift) and drift > 0.1


def test_the_rerun_recording_can_be_read_back(
    tmp_path: Path, written: Callable[..., list[str]]
) -> None:
    pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    from rerun.chunk import RrdReader

    written(facing_a_wall(3), write=("rrd",))
    reader = RrdReader(tmp_path / "out" / "output.rrd")
    assert [entry.application_id for entry in reader.recordings()] == ["dyfn_replay"]
    rows: dict[str, int] = {}
    for chunk in reader.stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    wanted = ("camera", "camera/image", "camera/depth", "points", "scores/median_depth")
    assert {name: rows.get(f"/{name}") for name in wanted} == dict.fromkeys(wanted, 3)


def test_rerun_that_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rerun", None)
    record(tmp_path / "walk", facing_a_wall(1))
    arguments = [str(tmp_path / "walk"), "--out", str(tmp_path / "out"), "--model", "tiny"]
    assert main([*arguments, "--write", "rrd"], load_tiny) == UNUSABLE
    assert "rerun is not installed: pip install 'dyfn_ros[rerun]'" in capsys.readouterr().err


@contextmanager
def small_files(size: int) -> Iterator[None]:
    """No file may exceed so many bytes, as if the disk were full.

    Not a fixture: its end would come after pytest's own line about the test, which a log of that
    size refuses as well.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("name", [name for name in FILES if name != "rrd"])
def test_a_full_disk_leaves_no_half_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    arguments = noisy_walk(tmp_path)
    with small_files(20_000):
        code = main([*arguments, "--write", name], load_tiny)
    assert code == UNUSABLE
    assert "cannot be written" in capsys.readouterr().err
    assert list((tmp_path / "out").iterdir()) == []


def noisy_walk(folder: Path) -> list[str]:
    """A recording that no codec makes small, and the arguments to replay it."""
    rng = np.random.default_rng(0)
    noise = [
        FrameToRecord(
            rng.integers(0, 255, (*SIZE, 3), np.uint8), f.depth_m, CAMERA, f.pose, f.stamp
        )
        for f in facing_a_wall(12)
    ]
    record(folder / "walk", noise)
    return [str(folder / "walk"), "--out", str(folder / "out"), "--model", "tiny"]


def test_a_full_disk_leaves_no_half_rerun_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    room = iter([ROOM, ROOM, ROOM - 1])
    monkeypatch.setattr(
        "dyfn_ros.replay.rerun.shutil.disk_usage", lambda _: SimpleNamespace(free=next(room))
    )
    assert main([*noisy_walk(tmp_path), "--write", "rrd"], load_tiny) == UNUSABLE
    assert "output.rrd: cannot be written: 64 MB are free" in capsys.readouterr().err
    assert list((tmp_path / "out").iterdir()) == []
    assert next(room, None) is None


ODOMETRY = "nav_msgs/msg/Odometry"


def odometry(path: Path, tie: bool) -> None:
    """A base that moves along x, with a camera 0.5 m ahead of it that looks forward."""
    types = TYPES.types
    with RecordingWriter(path, overwrite=True) as writer:
        mount = np.eye(4)
        mount[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
        mount[0, 3] = 0.5
        if tie:
            writer.write_transform(mount, 0, "base", "camera_optical", "/tf_static")
        for index in range(3):
            zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
            pose = types["geometry_msgs/msg/Pose"](
                position=types["geometry_msgs/msg/Point"](x=float(index), y=0.0, z=0.0),
                orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
            )
            cov = np.zeros(36)
            message = types[ODOMETRY](
                header=header(index * 200_000_000, "odom"),
                child_frame_id="base",
                pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=cov),
                twist=types["geometry_msgs/msg/TwistWithCovariance"](
                    twist=types["geometry_msgs/msg/Twist"](linear=zero, angular=zero),
                    covariance=cov,
                ),
            )
            writer.write("/odom", ODOMETRY, message, index * 200_000_000)


def test_odometry_is_carried_to_the_camera(tmp_path: Path) -> None:
    odometry(tmp_path / "odo", tie=True)
    where = open_poses(tmp_path / "odo", "camera_optical")
    found = where(0, 300_000_000)
    assert found is not None
    np.testing.assert_allclose(found[:3, 3], [2.0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(found[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-9)
    assert where(0, 410_000_000) is not None and where(0, 500_000_000) is None
    odometry(tmp_path / "odo", tie=False)
    with pytest.raises(PoseError, match="is of 'base', the images are of 'camera_optical'"):
        open_poses(tmp_path / "odo", "camera_optical")


def test_poses_between_two_are_interpolated(tmp_path: Path) -> None:
    record(tmp_path / "walk", facing_a_wall(3))
    for topic in (None, "/tf", "/camera/pose"):
        where = open_poses(tmp_path / "walk", "camera_optical", topic)
        found = where(0, 50_050_000_000)
        assert found is not None
        np.testing.assert_allclose(found[:3, 3], [0.05, 0, 0.15], atol=1e-9)
        turned = Rotation.from_matrix(found[:3, :3]).as_euler("xyz", degrees=True)
        np.testing.assert_allclose(turned, [0, 0, 2.5], atol=1e-9)


def test_several_pose_topics_are_listed(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "walk") as writer:
        for topic in ("/a", "/b"):
            writer.write_pose(topic, np.eye(4), 0, "world")
    with pytest.raises(PoseError, match=r"choose one with --pose-topic: /a \(geo.*\), /b"):
        open_poses(tmp_path / "walk", "camera")


def test_an_rgbd_folder_has_its_poses(tmp_path: Path) -> None:
    (tmp_path / "rgb").mkdir()
    for index in range(3):
        cv2.imwrite(str(tmp_path / "rgb" / f"{index}.png"), np.zeros((*SIZE, 3), np.uint8))
    with pytest.raises(PoseError, match=r"holds no poses\.txt"):
        open_poses(tmp_path, "camera_optical")
    np.savetxt(tmp_path / "poses.txt", [camera_pose(i).ravel() for i in range(3)])
    where = open_poses(tmp_path, "camera_optical")
    np.testing.assert_allclose(where(2, 200_000_000), camera_pose(2))  # type: ignore[arg-type]
    # The stamp tells the frame: its index is another one when a picture was lost before it.
    np.testing.assert_allclose(where(0, 100_000_000), camera_pose(1))  # type: ignore[arg-type]
