"""Flicker on a ray-cast scene: nothing where depth is true, the jitter's size where it jitters.

A room with a pillar, and a ball that comes nearer. The camera rests for some frames, creeps by less
than a pixel a frame, then walks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
import trimesh

from dyfn_core.evaluation.temporal import TemporalScorer
from dyfn_core.prediction import DEPTH

pytest.importorskip("embreex", reason="rays are cast by embree, of the extra `worlds`")

SIZE = (72, 96)
MATRIX = np.array([[80.0, 0, 47.5], [0, 80.0, 35.5], [0, 0, 1]])
REST, CREEP, WALK = 5, 4, 3  # frames
JITTER = np.array([1, 1.03, 0.98, 1.05, 1, 1.02, 0.97, 1.04, 1, 1.01, 0.96, 1.02])


@dataclass(frozen=True)
class View:
    """image: H x W x 3 uint8. depth: H x W metres. ball: H x W bool, where the ball is seen."""

    image: np.ndarray
    depth: np.ndarray
    ball: np.ndarray
    pose: np.ndarray


def camera_pose(index: int) -> np.ndarray:
    """A creep of 4 mm is 0.16 pixels at 2 m, a step of 15 cm is 3 at 4 m."""
    pose = np.eye(4)
    creeping, walking = np.clip([index + 1 - REST, index + 1 - REST - CREEP], 0, None)
    pose[:3, 3] = [0.004 * min(creeping, CREEP) + 0.15 * walking, 0, -1.5]
    return pose


def render(index: int) -> View:
    """Rays through the centres of the pixels against the triangles of frame `index`."""
    room = trimesh.creation.box((5.0, 3.0, 7.0))
    pillar = trimesh.creation.cylinder(0.3, 3.0, sections=24)
    pillar.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    pillar.apply_translation([-0.9, 0, 1.0])
    ball = trimesh.creation.icosphere(3, 0.4)
    ball.apply_translation([0.8, 0.2, 2.0 - 0.12 * index])
    first_of_ball = len(room.faces) + len(pillar.faces)
    scene = trimesh.util.concatenate([room, pillar, ball])
    pose = camera_pose(index)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    rays = np.stack([u, v, np.ones(SIZE)], axis=-1).reshape(-1, 3) @ np.linalg.inv(MATRIX).T
    origins = np.tile(pose[:3, 3], (len(rays), 1))
    hits, which, triangles = scene.ray.intersects_location(origins, rays, multiple_hits=False)
    depth, ball_seen = np.full(len(rays), np.nan), np.zeros(len(rays), bool)
    depth[which] = hits[:, 2] - pose[2, 3]
    ball_seen[which] = triangles >= first_of_ball
    image = np.zeros((len(rays), 3), np.uint8)
    image[which] = 127 + 100 * np.sin(3 * hits)
    return View(
        image.reshape(*SIZE, 3),
        depth.reshape(SIZE).astype(np.float32),
        ball_seen.reshape(SIZE),
        pose,
    )


@pytest.fixture(scope="module")
def views() -> list[View]:
    return [render(index) for index in range(REST + CREEP + WALK)]


def maps(views: list[View]) -> Iterator[dict[str, np.ndarray]]:
    """What methods say: the truth in another unit; with a scale of its own each frame; with a
    ball of its own each frame; with noise."""
    rng = np.random.default_rng(0)
    for view, scale in zip(views, JITTER, strict=True):
        said = view.depth / 3
        noise = (1 + 0.02 * rng.standard_normal(SIZE)).astype(np.float32)
        balls = np.where(view.ball, said * scale**5, said)
        yield {"true": said, "jitter": said * scale, "ball": balls, "noise": said * noise}


def measured(views: list[View], part: slice, poses: bool = True) -> dict[str, dict]:
    said = list(maps(views))
    with TemporalScorer() as scorer:
        for view, found in list(zip(views, said, strict=True))[part]:
            pose = view.pose if poses else None
            scorer.push(view.image, view.depth, found, MATRIX, pose)
        return scorer.results(dict.fromkeys(said[0], (3.0, 0.0, DEPTH)))


def change(part: slice) -> float:
    """The mean relative step of the scale: what flicker is where nothing else changes."""
    return float(np.mean(np.abs(np.diff(JITTER[part]) / JITTER[part][:-1])))


@pytest.mark.parametrize("poses", [True, False], ids=["poses", "brightness"])
def test_a_resting_camera_sees_the_jitter_and_nothing_else(views: list[View], poses: bool) -> None:
    assert sum(view.ball.sum() for view in views[:REST]) > 500
    part = slice(0, REST)
    found = measured(views, part, poses)
    assert found["truth"]["flicker"] < 2e-4
    assert found["true"]["flicker"] == pytest.approx(found["truth"]["flicker"], abs=1e-6)
    assert found["ball"]["flicker"] == pytest.approx(found["truth"]["flicker"], abs=1e-3)
    assert found["jitter"]["flicker"] == pytest.approx(change(part), rel=0.005)
    # Of two independent deviations of 2%, E|a - b| = 2 * 0.02 / sqrt(pi).
    assert found["noise"]["flicker"] == pytest.approx(0.04 / np.sqrt(np.pi), rel=0.05)
    assert {result["flicker_pairs"] for result in found.values()} == {REST - 1}


def test_a_creeping_camera_adds_what_the_truth_itself_changes(views: list[View]) -> None:
    part = slice(REST, REST + CREEP)
    found = measured(views, part)
    assert 0 < found["truth"]["flicker"] < 2e-3
    assert found["true"]["flicker"] == pytest.approx(found["truth"]["flicker"], abs=1e-6)
    assert found["jitter"]["flicker"] == pytest.approx(change(part), rel=0.02)
    moving = found["truth"]["tae"]  # what the ball leaves even to the truth
    assert found["jitter"]["tae"] == pytest.approx(change(part), abs=moving)


def test_where_the_camera_walks_nothing_stands_still(views: list[View]) -> None:
    found = measured(views, slice(REST + CREEP, None))
    assert {result["flicker"] for result in found.values()} == {None}
    assert found["jitter"]["tae"] > 3 * found["true"]["tae"]
