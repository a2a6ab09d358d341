"""What rooms look like: photographed surfaces, mirrored light, sunlight, smooth edges."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dyfn_worlds.camera.cameras import pose_at
from dyfn_worlds.camera.photographer import Photographer
from dyfn_worlds.render.renderer import Picture, RenderCamera, Renderer, Shading
from dyfn_worlds.scene import textures
from dyfn_worlds.scene.actors import STILL
from dyfn_worlds.scene.builder import SceneBuilder
from dyfn_worlds.scene.palette import Palette
from dyfn_worlds.scene.scene import Light, Scene, Window
from tests.support.small_camera import rays

DOWN = RenderCamera(pose_at(np.array([2.0, 2.0, 2.5]), 0.0, -np.pi / 2, 0.0), (0.5, 0.5 * 4 / 3))


def empty_room(**fields: object) -> SceneBuilder:
    """A grey box of 4 x 4 x 3 m."""
    builder = SceneBuilder()
    grey = builder.texture("grey", np.full((4, 4, 3), 160, np.uint8))
    corners = np.array([[0, 0], [4, 0], [4, 4], [0, 4]], float)
    builder.quad(np.column_stack([corners, np.zeros(4)]), grey)
    builder.quad(np.column_stack([corners[::-1], np.full(4, 3.0)]), grey)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        builder.quad(np.array([[*b, 0], [*a, 0], [*a, 3], [*b, 3]]), grey)
    return builder


def floor_points(picture: Picture, camera: RenderCamera) -> np.ndarray:
    """H x W x 3 world points of what is seen."""
    return (rays(camera) * picture.depth[..., None]) @ camera.pose[:3, :3].T + camera.pose[:3, 3]


def sunlit(bars: int) -> tuple[Window, Scene]:
    """The window is in the wall x = 0; the sun is 45 degrees high straight behind it."""
    up, right = np.array([0.0, 0, 0.5]), np.array([0.0, -0.8, 0])
    window = Window(np.array([0.0, 2.0, 1.5]), right, up, bars)
    way = np.array([1.0, 0, -1.0]) / np.sqrt(2)
    light = Light(window.centre - 15 * way, way, np.full(3, 2000.0), 10.0, window)
    return window, empty_room().build(lights=[light], ambient=np.full(3, 0.02, np.float32))


def test_sunlight_falls_where_the_window_lets_it_through(renderer: Renderer) -> None:
    _, scene = sunlit(bars=0)
    renderer.load(scene)
    picture = renderer.draw(DOWN, Shading(gloss=0.0))
    x, y, _ = np.moveaxis(floor_points(picture, DOWN), -1, 0)
    bright = picture.image.mean(axis=2) > 100
    # at 45 degrees a window from 1.0 to 2.0 m lights about 1.0 to 2.0 m of the floor
    inside = (x > 1.1) & (x < 1.9) & (abs(y - 2) < 0.75)
    outside = (x < 0.9) | (x > 2.15) | (abs(y - 2) > 0.95)
    assert bright[inside].mean() > 0.97
    assert bright[outside].mean() < 0.03


def test_a_windows_bar_is_seen_in_the_sunlight(renderer: Renderer) -> None:
    lit = []
    for bars in (0, 1):
        _, scene = sunlit(bars)
        renderer.load(scene)
        picture = renderer.draw(DOWN, Shading(gloss=0.0))
        lit.append(float((picture.image.mean(axis=2) > 100).mean()))
    assert 0.6 * lit[0] < lit[1] < 0.97 * lit[0]


def test_a_glossy_floor_mirrors_the_lamp_and_a_dull_one_does_not(renderer: Renderer) -> None:
    builder = empty_room()
    glow = builder.texture("glow", np.full((4, 4, 3), 255, np.uint8))
    panel = np.array([[2.6, 2.4, 2.98], [3.4, 2.4, 2.98], [3.4, 1.6, 2.98], [2.6, 1.6, 2.98]])
    builder.quad(panel, glow, emission=9.0)
    for index in range(2, 8):  # the floor's layer decides its gloss; the eighth is a glossy one
        builder.texture(index, np.full((4, 4, 3), 60, np.uint8))
    builder.quad(np.array([[0, 0, 0.01], [4, 0, 0.01], [4, 4, 0.01], [0, 4, 0.01]]), 5)
    renderer.load(builder.build())
    camera = RenderCamera(pose_at(np.array([0.3, 2.0, 1.0]), 0.0, -0.35, 0.0), (0.6, 0.8))
    dull = renderer.draw(camera, Shading(gloss=0.0))
    glossy = renderer.draw(camera, Shading(gloss=0.8))
    gain = glossy.image.astype(float).mean(axis=2) - dull.image.mean(axis=2)
    x, y, z = np.moveaxis(floor_points(dull, camera), -1, 0)
    # a lamp at x = 3, 2.98 m high, seen from x = 0.3, 1 m high, is mirrored at 0.3 + 2.7 / 3.98
    mirrored = (abs(z - 0.01) < 0.02) & (abs(x - 0.98) < 0.12) & (abs(y - 2) < 0.1)
    aside = (abs(z - 0.01) < 0.02) & (abs(x - 0.98) < 0.12) & (abs(y - 2) > 0.5)
    assert mirrored.any() and aside.any()
    assert gain[mirrored].mean() > gain[aside].mean() + 5


def test_edges_are_smooth_and_depth_is_not_averaged(renderer: Renderer) -> None:
    builder = empty_room()
    white = builder.texture("white", np.full((4, 4, 3), 255, np.uint8))
    builder.box(np.array([1.5, 1.5, 0.0]), np.array([2.5, 2.5, 1.0]), white, yaw=0.3)
    scene = builder.build(viewpoints=np.array([[1.0, 1.0, 2.0]]))
    photographer = Photographer(renderer, scene, np.random.default_rng(0))
    photographer.style = replace(photographer.style, shutter=0.0, corners=0.0)
    sharp = renderer.draw(DOWN, photographer._look(1.0))
    view = photographer._shoot(lambda _: DOWN, lambda _: STILL, 0.5, 1.0, "view")
    np.testing.assert_array_equal(view.depth, sharp.depth)
    top = abs(sharp.depth - 1.5) < 1e-3
    edge = cv2.dilate(top.astype(np.uint8), np.ones((3, 3))) != cv2.erode(
        top.astype(np.uint8), np.ones((3, 3))
    )
    change = abs(view.image.astype(float) - sharp.image).mean(axis=2)
    assert change[edge].mean() > 3 * change[~edge].mean()
    # a pixel on the edge lies between what it had on either side
    white, grey = sharp.image[top & ~edge].mean(), sharp.image[~top & ~edge].mean()
    between = [
        ((image.mean(axis=2) > grey + 8) & (image.mean(axis=2) < white - 8))[edge].mean()
        for image in (sharp.image, view.image)
    ]
    assert between[1] > between[0] + 0.15


@pytest.fixture
def art(tmp_path: Path) -> Path:
    for folder, color in (("backgrounds/a", (20, 30, 200)), ("textures", (40, 120, 60))):
        (tmp_path / folder).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / folder / "one.png"), np.full((300, 400, 3), color, np.uint8))
    cv2.imwrite(str(tmp_path / "textures" / "icon.png"), np.zeros((32, 32, 3), np.uint8))
    (tmp_path / "textures" / "broken.jpg").write_text("no picture")
    return tmp_path


def test_a_palette_finds_photographs_and_materials(art: Path) -> None:
    palette = Palette.find(art)
    assert [p.name for p in palette.photographs] == ["one.png"]
    assert [p.name for p in palette.materials] == ["broken.jpg", "icon.png", "one.png"]
    rng = np.random.default_rng(0)
    pictures = [palette.picture(rng) for _ in range(20)]
    assert {p.shape for p in pictures} == {(256, 256, 3)}
    assert any((p == (200, 30, 20)).all() for p in pictures)


def test_a_surface_is_a_photograph_as_it_is_or_in_the_wanted_colour(art: Path) -> None:
    palette = Palette.find(art)
    palette.materials = palette.materials[2:]
    drawn = np.full((256, 256, 3), (100, 50, 25), np.uint8)
    means = {
        tuple(palette.surface(np.random.default_rng(seed), lambda _: drawn).mean(axis=(0, 1)))
        for seed in range(40)
    }
    assert (60, 120, 40) in means
    assert (100, 50, 25) in means


def test_pictures_that_cannot_be_used_leave_own_materials(art: Path) -> None:
    palette = Palette.find(art)
    palette.materials, palette.share = palette.materials[:2], 1.0
    surface = palette.surface(np.random.default_rng(0), textures.wood)
    np.testing.assert_array_equal(surface, textures.wood(np.random.default_rng(0)))
    empty = Palette()
    assert empty.picture(np.random.default_rng(1)).shape == (256, 256, 3)
    assert empty.outdoors(np.random.default_rng(1)).shape == (256, 256, 3)
