"""What moves and changes in the worlds: figures, ways, light, exposure records, corners."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from dyfn_worlds.camera.cameras import FreeSpace, pose_at
from dyfn_worlds.camera.paths import CameraPath
from dyfn_worlds.camera.staging import LightScript, Way, stand
from dyfn_worlds.generate import RoomWorlds, ShardJob, render
from dyfn_worlds.maps import md3
from dyfn_worlds.render.occlusion import occlusion
from dyfn_worlds.render.renderer import RenderCamera, Renderer
from dyfn_worlds.scene.actors import Actor, Moment, Placement
from dyfn_worlds.scene.builder import SceneBuilder, new_vertices, stiff_actor
from tests.support.small_camera import SIZE


def box_actor(builder: SceneBuilder) -> Actor:
    own = SceneBuilder()
    own.textures = builder.textures
    layer = own.texture("red", np.full((4, 4, 3), (200, 30, 30), np.uint8))
    own.box(np.array([-0.5, -0.5, 0.0]), np.array([0.5, 0.5, 1.0]), layer)
    return stiff_actor("box", own)


def hall() -> SceneBuilder:
    builder = SceneBuilder()
    grey = builder.texture("grey", np.full((4, 4, 3), 120, np.uint8))
    builder.quad(np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0.0]]), grey)
    builder.quad(np.array([[6, 9, 0], [6, -9, 0], [6, -9, 9], [6, 9, 9.0]]), grey)
    return builder


def test_an_actor_is_drawn_where_it_is_placed_and_masked(renderer: Renderer) -> None:
    builder = hall()
    actor = box_actor(builder)
    renderer.load(builder.build(actors=[actor]))
    camera = RenderCamera(pose_at(np.array([0.0, 0, 0.5]), 0, 0, 0), (0.8, 1.06))
    here = renderer.draw(camera, moment=Moment((Placement(0, (3.5, 0, 0), 0.0),)))
    gone = renderer.draw(camera)
    assert here.depth[24, 32] == pytest.approx(3.0, rel=1e-4)
    assert here.moving[24, 32] and not here.moving[24, 2]
    assert not gone.moving.any() and gone.depth[24, 32] == pytest.approx(6.0, rel=1e-4)
    np.testing.assert_array_equal(here.depth[~here.moving], gone.depth[~here.moving])


def test_poses_in_between_are_interpolated_and_a_loop_closes() -> None:
    points = np.array([[[0.0, 0, 0]], [[1.0, 0, 0]]], np.float32)
    actor = Actor("a", new_vertices(1), points, points, np.zeros((0, 3)), (0, 2), (0, 1), 1, 0.1)
    for phase, expected in ((0.0, 0.0), (0.25, 0.5), (0.5, 1.0), (0.75, 0.5), (1.0, 0.0)):
        posed = actor.posed(Placement(0, (0, 0, 2), 0.0, walking=True, phase=phase))
        np.testing.assert_allclose(posed["position"][0], [expected, 0, 2], atol=1e-6)


def test_a_way_goes_there_and_back_with_a_pause() -> None:
    floor = np.array([[0.0, 0, 0], [2.0, 0, 0]])
    way = Way(0, floor, 1.0, pause=1.0, start=0.0, yaw=0.0, spin=0.0, stride=1.0)
    x = [way.at(t).position[0] for t in (0, 1, 2.5, 4, 5.5)]
    np.testing.assert_allclose(x, [0, 1, 2, 1, 0], atol=1e-9)
    assert [way.at(t).walking for t in (1, 2.5, 4)] == [True, False, True]
    assert abs(way.at(4).yaw - way.at(1).yaw) == pytest.approx(np.pi)


def test_actors_stand_on_the_floor_and_not_on_tables() -> None:
    builder = hall()
    layer = builder.texture("grey", np.full((4, 4, 3), 120, np.uint8))
    builder.box(np.array([1.0, -0.5, 0]), np.array([2.0, 0.5, 0.7]), layer)
    actor = box_actor(builder)
    space = FreeSpace(builder.build())
    camera = RenderCamera(pose_at(np.array([0.0, 0, 1.5]), 0, -0.2, 0), (0.8, 1.06))
    rng = np.random.default_rng(0)
    placed = [p for _ in range(30) for p in stand(space, rng, [actor], camera, 1)]
    assert len(placed) > 5
    assert all(abs(p.position[2]) < 1e-4 for p in placed)


def test_a_switched_lamp_goes_out_and_only_that_one() -> None:
    script = LightScript("switch", 1, 0.0, when=2.0, lasts=1.0, rising=False)
    before, after = script.at(1.0, 3), script.at(3.0, 3)
    assert before == ((1.0, 1.0, 1.0), 1.0)
    assert after[0] == (1.0, 0.0, 1.0) and 0.5 < after[1] < 1.0
    assert LightScript("steady", -1, 0.2, 1, 1, True).at(5.0, 0) == ((), 1.0)


def test_a_plane_has_no_corner_and_a_crease_has_one() -> None:
    v, u = np.mgrid[:60, :80] + 0.5
    inverse = 0.2 + 0.002 * u + 0.004 * v
    plane = occlusion((1 / inverse).astype(np.float32), 64.0)[15:-15, 15:-15]
    assert plane.max() < 1e-3
    crease = 2.0 / (1 + 0.5 * np.abs(u - 40) / 32)
    share = occlusion(crease.astype(np.float32), 64.0)[15:-15]
    assert share[:, 40].mean() > 10 * max(share[:, 17].mean(), 1e-3)


def test_speeds_of_a_path_are_per_second() -> None:
    from dyfn_worlds.camera.cameras import CameraLens
    from dyfn_worlds.camera.paths import RATE

    t = np.arange(121)[:, None] / RATE
    path = CameraPath(t * [0.5, 0, 0], t * [0.4, 0, 0], CameraLens((0.8, 1.0)))
    metres, degrees = path.speed(1.0)
    assert metres == pytest.approx(0.5, rel=1e-6)
    assert degrees == pytest.approx(np.degrees(0.4), rel=1e-3)


def test_every_frame_says_how_it_was_taken(tmp_path: Path, renderer: Renderer) -> None:
    job = ShardJob("rooms", 1, 0, 6, 3, SIZE)
    for name in ("a", "b"):
        render(job, RoomWorlds(tmp_path), tmp_path / name, lambda line: None)
    (meta_path,) = (tmp_path / "a").rglob("meta.json")
    meta = json.loads(meta_path.read_text())
    assert len(meta["frames"]) == meta["count"] == 6
    wanted = {"exposure", "blur_px", "lighting", "lamps", "ambient", "moving", "pace", "speed",
              "turn", "jitter", "moving_share"}  # fmt: skip
    assert all(wanted <= frame.keys() for frame in meta["frames"])
    assert {"shutter", "lag", "contrast"} <= meta["style"].keys()
    for index, frame in enumerate(meta["frames"]):
        mask = cv2.imread(str(meta_path.parent / f"{index:05d}_moving.png"), cv2.IMREAD_UNCHANGED)
        share = 0.0 if mask is None else (mask > 0).mean()
        assert share == pytest.approx(frame["moving_share"], abs=1e-4)
    files = [sorted(p for p in (tmp_path / n).rglob("*.*") if p.is_file()) for n in ("a", "b")]
    assert [p.read_bytes() for p in files[0]] == [p.read_bytes() for p in files[1]]


def model(positions: np.ndarray) -> bytes:
    """An .md3 of one triangle: positions frames x 3 x 3 in map units, one tag at (0, 0, 8)."""
    frames = len(positions)
    header, surface = np.zeros(1, md3.HEADER), np.zeros(1, md3.SURFACE)
    tags, points = np.zeros(frames, md3.TAG), np.zeros((frames, 3), md3.POINT)
    tags["name"], tags["origin"], tags["axis"] = b"tag_torso", [0, 0, 8], np.eye(3)
    points["position"] = positions * 64
    triangle, uv = np.array([0, 1, 2], "<i4"), np.zeros((3, 2), "<f4")
    at = [surface.nbytes, surface.nbytes + 12, surface.nbytes + 12 + uv.nbytes]
    for key, value in zip(("at_triangles", "at_uv", "at_vertices"), at, strict=True):
        surface[key] = value
    surface["frames"], surface["vertices"], surface["triangles"] = frames, 3, 1
    surface["name"], surface["at_end"] = b"Body", at[2] + points.nbytes
    header["ident"], header["version"], header["frames"] = b"IDP3", 15, frames
    header["tags"], header["surfaces"], header["at_tags"] = 1, 1, header.nbytes
    header["at_surfaces"] = header.nbytes + tags.nbytes
    parts = [header, tags, surface, triangle, uv, points]
    return b"".join(p.tobytes() for p in parts)


def test_a_model_written_here_comes_back() -> None:
    positions = np.arange(18, dtype=np.float64).reshape(2, 3, 3)
    read = md3.read_model(model(positions), "made.md3")
    assert read.frames == 2 and read.surfaces[0].name == "body"
    np.testing.assert_allclose(read.surfaces[0].positions, positions)
    assert read.surfaces[0].triangles.tolist() == [[2, 1, 0]]
    np.testing.assert_allclose(read.tags["tag_torso"][0], [[0, 0, 8]] * 2)


@pytest.mark.parametrize("data", [b"", b"IDP3" + bytes(20), b"nope" + bytes(200)])
def test_a_damaged_model_is_refused_by_name(data: bytes) -> None:
    with pytest.raises(md3.ModelError, match=r"made\.md3"):
        md3.read_model(data, "made.md3")


def test_leg_frames_are_counted_as_the_legs_model_counts_them() -> None:
    text = "sex m\n" + "".join(f"{10 * i} 10 0 15\n" for i in range(25))
    ranges = md3.animations(text)
    assert ranges[md3.TORSO_GESTURE] == (60, 10)
    assert ranges[md3.LEGS_FIRST] == (60, 10) and ranges[md3.LEGS_WALK] == (70, 10)
    with pytest.raises(md3.ModelError, match="animation"):
        md3.animations("0 1 0 15")
