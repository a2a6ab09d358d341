"""Rendered views: depth, intrinsics and poses are checked against ray casting, by value."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from dyfn_worlds.camera.cameras import CLEARANCE, CameraLens, FreeSpace, pose_at
from dyfn_worlds.camera.paths import random_path
from dyfn_worlds.generate import RoomWorlds, ShardJob, render
from dyfn_worlds.render.renderer import RenderCamera, Renderer
from dyfn_worlds.rooms.rooms import furnished_room
from dyfn_worlds.scene.builder import SceneBuilder
from dyfn_worlds.scene.scene import Light, Scene
from dyfn_worlds.shards import DEPTH_INFINITE, RenderedView, encode_depth, write_shard
from tests.support.small_camera import SIZE, rays


@pytest.fixture(scope="module")
def room() -> Scene:
    return furnished_room(np.random.default_rng(3), None)


def test_depth_is_the_ray_cast_z_at_every_pixel_centre(renderer: Renderer, room: Scene) -> None:
    renderer.load(room)
    camera = RenderCamera(
        pose_at(room.viewpoints[0], 0.7, -0.3, 0.2), (0.8, 0.8 * 4 / 3), (0.47, 0.55)
    )
    depth = renderer.draw(camera).depth
    way = rays(camera) @ camera.pose[:3, :3].T
    length = np.linalg.norm(way, axis=-1)
    origins = np.broadcast_to(camera.pose[:3, 3], way.shape).reshape(-1, 3)
    cast = FreeSpace(room).distance(origins, (way / length[..., None]).reshape(-1, 3))
    expected = cast.reshape(SIZE) / length
    # a pixel centre on an edge may fall to either side; the others agree to float32
    error = np.abs(depth - expected) / expected
    assert np.mean(error < 1e-4) > 0.99


def test_the_sky_is_infinite_and_a_wall_hides_it(renderer: Renderer) -> None:
    builder = SceneBuilder()
    red = builder.texture("red", np.full((4, 4, 3), (255, 0, 0), np.uint8))
    builder.quad(np.array([[2.0, 0, -9], [2, -9, -9], [2, -9, 9], [2, 0, 9]]), red)
    light = Light(np.zeros(3), np.array([1.0, 0, 0]), np.full(3, 5.0))
    renderer.load(builder.build(lights=[light]))
    picture = renderer.draw(RenderCamera(pose_at(np.zeros(3), 0, 0, 0), (0.7, 0.9)))
    image, depth = picture.image, picture.depth
    left, right = depth[:, : SIZE[1] // 2], depth[:, SIZE[1] // 2 :]
    assert np.isinf(left).all()
    np.testing.assert_allclose(right, 2.0, rtol=1e-5)
    assert image[24, 60, 0] > image[24, 60, 1] + 20


def test_only_the_shown_triangles_are_drawn_until_the_next_scene(renderer: Renderer) -> None:
    builder = SceneBuilder()
    white = builder.texture("white", np.full((4, 4, 3), 255, np.uint8))
    for x in (2.0, 3.0):
        builder.quad(np.array([[x, 9, -9], [x, -9, -9], [x, -9, 9], [x, 9, 9]]), white)
    scene, camera = builder.build(), RenderCamera(pose_at(np.zeros(3), 0, 0, 0), (0.7, 0.9))
    renderer.load(scene)
    renderer.show(scene.triangles[2:])
    np.testing.assert_allclose(renderer.draw(camera).depth, 3.0, rtol=1e-5)
    renderer.load(scene)
    np.testing.assert_allclose(renderer.draw(camera).depth, 2.0, rtol=1e-5)


def test_a_shadow_falls_behind_what_stands_in_the_light(renderer: Renderer) -> None:
    builder = SceneBuilder()
    white = builder.texture("white", np.full((4, 4, 3), 255, np.uint8))
    builder.quad(np.array([[-5, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0.0]]), white)
    builder.box(np.array([-0.5, -0.5, 1.0]), np.array([0.5, 0.5, 1.2]), white)
    light = Light(np.array([0, 0, 2.5]), np.array([0, 0, -1.0]), np.full(3, 8.0))
    renderer.load(builder.build(lights=[light]))
    camera = RenderCamera(pose_at(np.array([-4.0, 0, 0.6]), 0, -0.15, 0), (0.8, 1.06))
    picture = renderer.draw(camera)
    image, depth = picture.image, picture.depth
    world = (rays(camera) * depth[..., None]) @ camera.pose[:3, :3].T + camera.pose[:3, 3]
    floor = np.abs(world[..., 2]) < 1e-3
    radius = np.linalg.norm(world[..., :2], axis=-1)
    dark, lit = image[floor & (radius < 0.5)], image[floor & (radius > 1.3) & (radius < 1.8)]
    assert dark.mean() < 0.7 * lit.mean()


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path, renderer: Renderer) -> None:
    job = ShardJob("rooms", 1, 4, 0, 5, SIZE)
    for name in ("a", "b"):
        render(job, RoomWorlds(tmp_path), tmp_path / name, lambda line: None)
    first, second = ((tmp_path / n).rglob("*.*") for n in ("a", "b"))
    contents = [[p.read_bytes() for p in sorted(files)] for files in (first, second)]
    assert len(contents[0]) >= 2 * 4 + 1
    assert contents[0] == contents[1]


def test_fewer_samples_change_the_colours_and_not_the_depth(
    tmp_path: Path, renderer: Renderer
) -> None:
    drawn = []
    for samples in (1, 2, 4):
        out, job = tmp_path / str(samples), ShardJob("rooms", 1, 4, 0, 5, SIZE, samples=samples)
        render(job, RoomWorlds(tmp_path), out, lambda line: None)
        depth, image = (next(out.rglob(f"00000.{kind}")) for kind in ("png", "jpg"))
        drawn.append((depth.read_bytes(), cv2.imread(str(image)).astype(float)))
    (depth_1, one), (depth_2, two), (depth_4, four) = drawn
    assert depth_1 == depth_2 == depth_4
    assert 0 < np.abs(two - four).mean() < np.abs(one - four).mean()


def test_a_path_keeps_clear_of_every_surface(room: Scene) -> None:
    space, rng = FreeSpace(room), np.random.default_rng(0)
    path = random_path(space, rng, CameraLens((0.8, 1.0)), 2.0)
    cameras = [path.at(t) for t in np.linspace(0, 2, 31)]
    positions = np.stack([c.pose[:3, 3] for c in cameras])
    assert space.clearance(positions).min() > 0.8 * CLEARANCE / 2
    for camera in cameras:
        np.testing.assert_allclose(
            camera.pose[:3, :3] @ camera.pose[:3, :3].T, np.eye(3), atol=1e-9
        )
        assert np.linalg.det(camera.pose[:3, :3]) == pytest.approx(1.0)


def test_depth_is_stored_in_millimetres_with_sky_and_unknown_apart(tmp_path: Path) -> None:
    depth = np.array([[1.2345, np.inf], [70.0, np.nan]], np.float32)
    assert encode_depth(depth).tolist() == [[1234, DEPTH_INFINITE], [0, 0]]
    camera = RenderCamera(np.eye(4), (0.8, 1.0))
    view = RenderedView(np.zeros((2, 2, 3), np.uint8), depth, camera)
    write_shard(tmp_path / "s", [view], {"world": "w"})
    stored = cv2.imread(str(tmp_path / "s" / "00000.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(stored, encode_depth(depth))
    meta = json.loads((tmp_path / "s" / "meta.json").read_text())
    assert meta["intrinsics"] == [[0.8, 1.0, 0.5, 0.5]]
    assert meta["done"] is True
