"""Reconstruction on a made room whose depth, poses and matches are exact."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from dyfn_core.data.frames import FrameError
from dyfn_core.evaluation.reconstruction.cloud_error import cloud_error, write_ply
from dyfn_core.evaluation.reconstruction.matching import (
    MatchWindow,
    build_matcher,
    partners,
    sample_at,
)
from dyfn_core.evaluation.reconstruction.poses import Reconstruction, ReconstructionOptions
from dyfn_core.evaluation.reconstruction.runs import (
    BASE,
    TRUE_DEPTH,
    WITH_DYFN,
    SequenceRuns,
    judge,
    reconstruct_sequence,
    reconstruction_table,
)
from dyfn_core.evaluation.reconstruction.trajectory import trajectory_error
from dyfn_core.geometry.registration import RegistrationError, Similarity
from tests.support.made_room import ExactMatcher, RoomSequence, camera_pose, room_frame
from tests.support.pinhole import PinholeModel

FRAMES = 16
OPTIONS = ReconstructionOptions(offsets=(1, 3, 7))


@pytest.fixture(scope="module")
def matcher() -> ExactMatcher:
    return ExactMatcher(FRAMES)


class Scaled(RoomSequence):
    """The room with depth multiplied by a factor per frame."""

    def __init__(self, factors: np.ndarray) -> None:
        super().__init__(len(factors))
        self.factors = factors

    def read(self, index: int):  # type: ignore[no-untyped-def]
        frame = room_frame(index)
        return type(frame)(
            frame.image, frame.depth * self.factors[index], frame.intrinsics, frame.pose
        )


def runs(
    matcher: ExactMatcher, factors: np.ndarray, options: ReconstructionOptions = OPTIONS
) -> SequenceRuns:
    """Poses and cloud of scaled depth, judged against the unscaled room."""
    found = reconstruct_sequence(Scaled(factors), range(len(factors)), matcher, None, options)
    exact = reconstruct_sequence(RoomSequence(FRAMES), range(FRAMES), matcher, None, options)
    found.true_cloud = exact.true_cloud
    return found


def test_exact_depth_gives_the_known_poses_and_cloud(matcher: ExactMatcher) -> None:
    found = runs(matcher, np.ones(FRAMES))
    result = judge(found, TRUE_DEPTH)
    assert (result.posed, result.problems) == (FRAMES, {})
    assert result.trajectory is not None and result.cloud is not None
    assert result.notes == ()
    assert result.trajectory.ate < 0.004
    assert result.trajectory.rpe_degrees < 0.15
    assert result.trajectory.alignment.scale == pytest.approx(1, abs=5e-3)
    assert result.cloud.chamfer < 0.02
    assert result.cloud.precision > 0.99 and result.cloud.completeness > 0.99
    world = Similarity.from_matrix(camera_pose(0))
    for pose, known in zip(found.runs[TRUE_DEPTH].poses, found.known, strict=True):
        assert pose is not None and known is not None
        np.testing.assert_allclose(world.after(pose).matrix, known, atol=0.02)


def test_one_unknown_scale_costs_nothing_and_drifting_scale_does(matcher: ExactMatcher) -> None:
    constant = judge(runs(matcher, np.full(FRAMES, 0.25)), TRUE_DEPTH)
    drift = np.exp(0.25 * np.sin(np.arange(FRAMES) * 0.9))
    drifting = runs(matcher, drift)
    worse = judge(drifting, TRUE_DEPTH)
    assert constant.cloud is not None and constant.trajectory is not None
    assert constant.cloud.chamfer < 0.02 and constant.trajectory.ate < 0.004
    assert worse.trajectory is None or worse.trajectory.ate > 5 * constant.trajectory.ate
    assert worse.cloud is None or worse.cloud.chamfer > 2 * constant.cloud.chamfer
    scaled = judge(
        runs(matcher, drift, ReconstructionOptions(offsets=(1, 3, 7), with_scale=True)), TRUE_DEPTH
    )
    assert scaled.cloud is not None and scaled.cloud.chamfer < 0.02


def test_true_poses_of_partners_stop_errors_from_adding_up(matcher: ExactMatcher) -> None:
    growing = Scaled(np.exp(0.02 * np.arange(FRAMES)))
    room = RoomSequence(FRAMES)
    chained, true, exact = (
        reconstruct_sequence(one, range(FRAMES), matcher, None, OPTIONS, true_poses=way)
        for one, way in ((growing, False), (growing, True), (room, True))
    )
    for pose, wanted in zip(exact.runs[TRUE_DEPTH].poses, exact.known, strict=True):
        assert pose is not None and wanted is not None
        np.testing.assert_allclose(pose.matrix, wanted, atol=0.02)
    last = true.runs[TRUE_DEPTH].poses[-1], chained.runs[TRUE_DEPTH].poses[-1]
    assert last[0] is not None and last[1] is not None
    begin, wanted = Similarity.from_matrix(camera_pose(0)), camera_pose(FRAMES - 1)[:3, 3]
    near, far = (
        np.linalg.norm(pose.translation - wanted) for pose in (last[0], begin.after(last[1]))
    )
    assert near < 0.5 * far, (near, far)


def test_predictions_are_in_metres_beside_true_poses(matcher: ExactMatcher) -> None:
    model = PinholeModel(stabilized=True).eval()
    found = reconstruct_sequence(
        RoomSequence(4), range(4), matcher, model, OPTIONS, true_poses=True
    )
    cloud = found.runs[BASE].cloud
    assert cloud is not None and found.true_cloud is not None
    reach, wanted = (np.ptp(c.cloud()[0], axis=0).max() for c in (cloud, found.true_cloud))
    assert 0.4 < reach / wanted < 2.5


def test_a_frame_without_a_true_pose_is_refused(matcher: ExactMatcher) -> None:
    class Unposed(RoomSequence):
        def read(self, index: int):  # type: ignore[no-untyped-def]
            frame = room_frame(index)
            return type(frame)(frame.image, frame.depth, frame.intrinsics, None)

    with pytest.raises(ValueError, match="room: a frame has no true pose"):
        reconstruct_sequence(Unposed(2), range(2), matcher, None, OPTIONS, true_poses=True)


def test_a_path_that_fixes_no_scale_is_told(matcher: ExactMatcher) -> None:
    found = runs(matcher, np.ones(FRAMES))
    rng = np.random.default_rng(0)
    found.known = [
        None if known is None else moved(known, rng.normal(0, 1, 3)) for known in found.known
    ]
    (note,) = judge(found, TRUE_DEPTH).notes
    assert note.startswith("the path's error, ")
    assert "fixes no scale" in note


def moved(pose: np.ndarray, by: np.ndarray) -> np.ndarray:
    result = pose.copy()
    result[:3, 3] += by
    return result


def test_a_reconstruction_is_the_same_each_time(matcher: ExactMatcher) -> None:
    first, second = (runs(matcher, np.ones(FRAMES)).runs[TRUE_DEPTH] for _ in range(2))
    assert first.cloud is not None and second.cloud is not None
    for a, b in zip(first.cloud.cloud(), second.cloud.cloud(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_frames_without_geometry_are_reported_and_bridged(matcher: ExactMatcher) -> None:
    window, run = MatchWindow(matcher, 7), Reconstruction(OPTIONS)
    for index in range(8):
        frame = matcher.frames[index]
        window.push(frame.image)
        points = to_points(frame.depth)
        valid = np.ones(frame.depth.shape, bool)
        if index in (0, 4):
            valid[:] = False
        if index == 5:
            valid[:, 10:] = valid[5:] = False
        run.push(frame.image, points, valid, window)
    problems = [frame.problem for frame in run.frames]
    assert problems[0] == "no valid point"
    assert str(problems[4]).startswith("too few pairs")
    assert problems[5] is not None
    assert [pose is None for pose in run.poses] == [i in (0, 4, 5) for i in range(8)]
    assert run.frames[6].partners == (3,)
    assert sum(run.problems().values()) == 3


def test_points_on_a_line_are_called_collinear(matcher: ExactMatcher) -> None:
    window, run = MatchWindow(matcher, 7), Reconstruction(OPTIONS)
    line = np.zeros((60, 80, 3)) + np.linspace(1, 1.05, 80)[None, :, None] * [0.1, 0.2, 1]
    for index in range(2):
        window.push(matcher.frames[index].image)
        run.push(matcher.frames[index].image, line, np.ones((60, 80), bool), window)
    assert run.frames[1].pose is None
    assert str(run.frames[1].problem).startswith("collinear")


def to_points(depth: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[:60, :80]
    return np.stack([(u - 39.5) / 60 * depth, (v - 29.5) / 60 * depth, depth], -1)


def test_with_and_without_dyfn_stand_in_one_table(matcher: ExactMatcher) -> None:
    found = reconstruct_sequence(
        RoomSequence(5), range(5), matcher, PinholeModel(stabilized=True).eval(), OPTIONS
    )
    table = reconstruction_table({name: judge(found, name) for name in found.runs})
    assert [row[0] for row in table.rows] == [TRUE_DEPTH, WITH_DYFN, BASE]
    assert all(len(row) == len(table.header) for row in table.rows)
    values = judge(found, TRUE_DEPTH).values()
    assert json.loads(json.dumps(values, allow_nan=False))["posed"] == 5
    with pytest.raises(ValueError, match="nothing to reconstruct"):
        reconstruct_sequence(RoomSequence(5), range(5), matcher, None, true_depth=False)


def test_unreadable_frames_are_counted(matcher: ExactMatcher) -> None:
    class Broken(RoomSequence):
        def read(self, index: int):  # type: ignore[no-untyped-def]
            if index != 2:
                raise FrameError("x.png: not a picture")
            return room_frame(index)

    found = reconstruct_sequence(Broken(4), range(4), matcher, None, OPTIONS)
    assert found.losses == {"x.png: not a picture": 3}
    result = judge(found, TRUE_DEPTH)
    assert result.trajectory is None and "stands still" in result.notes[0]


def test_pose_errors_are_those_put_in() -> None:
    known = [camera_pose(i) for i in range(10)]
    moved = Similarity(camera_pose(3)[:3, :3], np.array([1.0, 2, 3]), 0.4)
    poses = [moved.after(Similarity.from_matrix(pose)) for pose in known]
    exact = trajectory_error(poses, known)
    assert exact.ate < 1e-9 and exact.rpe_metres < 1e-9 and exact.rpe_degrees < 1e-6
    np.testing.assert_allclose(exact.alignment.matrix, moved.inverse().matrix, atol=1e-9)
    turned = list(poses)
    angle = np.radians(2.0)
    roll = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    turned[9] = Similarity(poses[9].rotation @ roll, poses[9].translation, poses[9].scale)
    assert trajectory_error(turned, known).rpe_degrees == pytest.approx(2 / 3, rel=1e-6)
    gaps: list[Similarity | None] = [None if i in (2, 5) else p for i, p in enumerate(poses)]
    truth = [pose if i != 7 else pose * np.nan for i, pose in enumerate(known)]
    assert trajectory_error(gaps, truth).frames == 7
    with pytest.raises(RegistrationError, match="stands still"):
        trajectory_error([Similarity.identity()] * 10, known)
    with pytest.raises(ValueError, match="9 estimated"):
        trajectory_error(poses[:9], known)


def test_a_straight_path_is_aligned_by_its_orientations() -> None:
    known = [np.eye(4) for _ in range(5)]
    for i, pose in enumerate(known):
        pose[2, 3] = 0.3 * i
    moved = Similarity(camera_pose(6)[:3, :3], np.array([1.0, 2, 3]), 0.4)
    found = trajectory_error([moved.after(Similarity.from_matrix(p)) for p in known], known)
    assert found.ate < 1e-9
    np.testing.assert_allclose(found.alignment.matrix, moved.inverse().matrix, atol=1e-9)


def test_cloud_error_knows_its_directions() -> None:
    truth = np.stack([*np.meshgrid(np.arange(10.0), np.arange(10.0)), np.zeros((10, 10))], -1)
    truth = truth.reshape(-1, 3)
    half = truth[truth[:, 0] < 5] + [0, 0, 0.03]
    found = cloud_error(half, truth, 0.05)
    assert found.accuracy == pytest.approx(0.03) and found.precision == 1
    assert found.completeness == 0.5
    assert found.completeness_distance == pytest.approx(
        0.015 + np.mean(np.hypot([1, 2, 3, 4, 5], 0.03)) / 2
    )
    assert found.chamfer == pytest.approx((found.accuracy + found.completeness_distance) / 2)
    with pytest.raises(ValueError, match="0 and 100 points"):
        cloud_error(truth[:0], truth, 0.05)


def test_a_ply_file_reads_back(tmp_path: Path) -> None:
    points, colours = np.array([[1.5, -2, 3], [0, 0, 1]]), np.array([[1, 2, 3], [255, 0, 9]])
    write_ply(tmp_path / "cloud.ply", points, colours.astype(np.uint8))
    read = trimesh.load(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(read.vertices, points)
    np.testing.assert_array_equal(read.colors[:, :3], colours)
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.ply"]


@pytest.mark.parametrize("name", ["dis", "sift", "orb", "dis+sift"])
def test_matchers_find_a_known_motion(name: str) -> None:
    rng = np.random.default_rng(0)
    import cv2

    picture = cv2.GaussianBlur(rng.integers(0, 255, (200, 260, 3), np.uint8), (0, 0), 1.5)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX)
    first, second = picture[20:180, 20:220], picture[26:186, 16:216]
    matcher = build_matcher(name)
    matches = matcher.match(matcher.describe(first), matcher.describe(second))
    assert len(matches) > 50
    moved = matches.second - matches.first
    assert (np.abs(moved - [4, -6]).max(1) < 1.5).mean() > 0.9
    flat = np.full((160, 200, 3), 127, np.uint8)
    if name in ("sift", "orb"):
        assert not len(matcher.match(matcher.describe(flat), matcher.describe(first)))


def test_an_unknown_matcher_is_named() -> None:
    with pytest.raises(ValueError, match="'loftr' is unknown, expected dis, sift"):
        build_matcher("dis+loftr")


def test_partners_are_those_with_a_pose_else_the_newest() -> None:
    assert partners((1, 3), [True, True, True]) == [1, 3]
    assert partners((1, 3), [True, True, False]) == [3]
    assert partners((1, 3), [False, True, False]) == [2]
    assert partners((1, 3), [False]) == []


def test_samples_are_bilinear_and_nearest_beside_holes() -> None:
    values = np.mgrid[:4, :5].transpose(1, 2, 0).astype(np.float32)
    found = sample_at(values, np.array([[1.25, 2.5], [4, 3], [0, 0], [5.2, 1]]))
    np.testing.assert_allclose(found[:3], [[2.5, 1.25], [3, 4], [0, 0]])
    assert np.isnan(found[3]).all()
    values[2, 2] = np.nan
    np.testing.assert_allclose(sample_at(values, np.array([[1.25, 1.75]])), [[2, 1]])
