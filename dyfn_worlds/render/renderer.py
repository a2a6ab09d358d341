"""Draws a Scene with OpenGL: colour, and depth exact to float32, in one pass.

Runs headless through EGL; Mesa's software rasteriser is enough. Shading: albedo times
(baked lightmap, or ambient plus shadow-mapped spot lights), tone mapped to sRGB.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np

from dyfn_worlds.render.shaders import (
    ACTOR_SHADOW_SIZE,
    DEPTH_SHADER,
    FRAGMENT_SHADER,
    MAX_LIGHTS,
    SHADOW_SHADER,
    SHADOW_SIZE,
    VERTEX_SHADER,
)
from dyfn_worlds.scene.actors import STILL, Actor, Moment, Placement
from dyfn_worlds.scene.scene import LIGHTMAP_SIZE, TEXTURE_SIZE, Light, Scene

NEAR = 0.05
MIRROR_SIZE = 128
BRIGHTEST = 60.0
NO_PANE = [0.0, 0.0, 0.0, -1.0]
# camera axes (right, down, forward) of the faces +x, -x, +y, -y, +z, -z as OpenGL samples them
CUBE_FACES = (
    ((0, 0, -1), (0, -1, 0), (1, 0, 0)),
    ((0, 0, 1), (0, -1, 0), (-1, 0, 0)),
    ((1, 0, 0), (0, 0, 1), (0, 1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((1, 0, 0), (0, -1, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, -1, 0), (0, 0, -1)),
)
ACTOR_ALPHA = 128  # of 255: where an actor covers the pixel; the static scene has 255

VERTEX_FORMAT = "3f 3f 2f 3f 2f 1i 1i 1f"
VERTEX_NAMES = (
    "in_position",
    "in_normal",
    "in_uv",
    "in_color",
    "in_lightmap_uv",
    "in_texture",
    "in_lightmap",
    "in_emission",
)


@dataclass(frozen=True)
class RenderCamera:
    """A pinhole camera. focal and centre are normalised by the image width and height.

    pose: 4 x 4 camera-to-world; camera axes are optical (x right, y down, z forward).
    """

    pose: np.ndarray
    focal: tuple[float, float]
    centre: tuple[float, float] = (0.5, 0.5)


@dataclass(frozen=True)
class Shading:
    """How radiance becomes a picture. gloss: strength of highlights and reflections; contrast: 0
    (soft) to 1."""

    exposure: float = 1.0
    gloss: float = 0.2
    contrast: float = 0.0


@dataclass(frozen=True)
class Picture:
    """image h x w x 3 uint8 RGB; depth h x w float32 metres, +inf for the sky; moving h x w bool:
    where an actor is seen."""

    image: np.ndarray
    depth: np.ndarray
    moving: np.ndarray


class _ActorMesh:
    """One actor's buffers on the GPU."""

    def __init__(self, renderer: Renderer, actor: Actor) -> None:
        ctx = renderer.ctx
        self.actor = actor
        self.vertices = ctx.buffer(reserve=actor.vertices.nbytes, dynamic=True)
        self.indices = ctx.buffer(np.ascontiguousarray(actor.triangles, np.int32).tobytes())
        self.drawn = renderer.vertex_arrays(self.vertices, self.indices)

    def place(self, placement: Placement) -> None:
        self.vertices.write(self.actor.posed(placement).tobytes())

    def objects(self) -> list[object]:
        return [self.vertices, self.indices, *self.drawn]


class Renderer:
    """One OpenGL context and one image size; scenes come and go.

    size: (height, width) of the images in pixels.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.ctx = moderngl.create_context(standalone=True, **{"backend": "egl"})  # type: ignore[arg-type]
        self.ctx.enable(moderngl.DEPTH_TEST)
        # moderngl types what a program holds as a union; the shaders above say which it is
        self.program: Any = self.ctx.program(VERTEX_SHADER, FRAGMENT_SHADER)
        self.depth_program: Any = self.ctx.program(DEPTH_SHADER, "#version 330\nvoid main() {}")
        self.ctx.depth_func = "<="
        self.shadow_program: Any = self.ctx.program(SHADOW_SHADER, "#version 330\nvoid main() {}")
        shape = (size[1], size[0])
        self.target = self._canvas(shape, "f1")
        self._mirror_target = self._canvas((MIRROR_SIZE, MIRROR_SIZE), "f2")
        self._scene_objects: list[object] = []
        self._actors: list[_ActorMesh] = []
        self._placed: tuple[Placement, ...] = ()

    def _canvas(self, shape: tuple[int, int], dtype: str) -> Any:
        """A framebuffer of (width, height): colour of a dtype, and depth in metres."""
        colour, depth = (
            self.ctx.texture(shape, 4, dtype=dtype),
            self.ctx.texture(shape, 1, dtype="f4"),
        )
        return self.ctx.framebuffer([colour, depth], self.ctx.depth_renderbuffer(shape))

    def vertex_arrays(self, vertices: Any, indices: Any) -> tuple[Any, Any, Any]:
        """The same triangles for the shading, the depth-only and the shadow program."""
        content = [(vertices, VERTEX_FORMAT, *VERTEX_NAMES)]
        plain = [(vertices, "3f 52x", "in_position")]
        return (
            self.ctx.vertex_array(self.program, content, indices, skip_errors=True),
            self.ctx.vertex_array(self.depth_program, plain, indices),
            self.ctx.vertex_array(self.shadow_program, plain, indices),
        )

    def load(self, scene: Scene) -> None:
        """Uploads the scene and draws its shadow maps; replaces the scene before."""
        self._release()
        self.scene = scene
        vertices = self.ctx.buffer(np.ascontiguousarray(scene.vertices).tobytes())
        indices = self.ctx.buffer(np.ascontiguousarray(scene.triangles, np.int32).tobytes())
        self.meshes = self.vertex_arrays(vertices, indices)
        textures = self._texture_array(scene.textures, TEXTURE_SIZE)
        textures.build_mipmaps()
        textures.filter = (moderngl.LINEAR_MIPMAP_NEAREST, moderngl.LINEAR)
        lightmaps = self._texture_array(scene.lightmaps, LIGHTMAP_SIZE)
        lightmaps.repeat_x = lightmaps.repeat_y = False
        self._lights = scene.lights[:MAX_LIGHTS]
        shadows, target = self._atlas(SHADOW_SIZE)
        self._draw_shadows(target, SHADOW_SIZE, [self.meshes[2]])
        actor_shadows, self._actor_target = self._atlas(ACTOR_SHADOW_SIZE)
        samplers: list[tuple[str, Any]] = [
            ("textures", textures),
            ("lightmaps", lightmaps),
            ("shadows", shadows),
            ("actor_shadows", actor_shadows),
        ]
        for unit, (name, texture) in enumerate(samplers):
            texture.use(unit)
            self.program[name] = unit
        self._set_lights(self._lights)
        self._actors = [_ActorMesh(self, actor) for actor in scene.actors]
        self._placed = ()
        surroundings = self._look_around(scene)
        self._scene_objects = [
            vertices, indices, *self.meshes, textures, lightmaps, shadows, target,
            surroundings, actor_shadows, self._actor_target,
            *(o for a in self._actors for o in a.objects()),
        ]  # fmt: skip

    def show(self, triangles: np.ndarray) -> None:
        """Draws only these of the scene's triangles from now on, say those that may be in view.

        triangles: T x 3 indices of the scene's vertices. Shadows stay those of the whole scene.
        """
        indices = self.ctx.buffer(np.ascontiguousarray(triangles, np.int32).tobytes())
        self.meshes = self.vertex_arrays(self._scene_objects[0], indices)
        self._scene_objects += [indices, *self.meshes]

    def draw(
        self,
        camera: RenderCamera,
        look: Shading = Shading(),
        moment: Moment = STILL,
        shrink: int = 1,
    ) -> Picture:
        """One picture of the scene at a moment.

        shrink: h x w is the renderer's size divided by it; for a cheap look before a full one.
        """
        height, width = self.size[0] // shrink, self.size[1] // shrink
        self._set_moment(moment)
        self._set_camera(camera, look)
        self.target.use()
        self.target.viewport = (0, 0, width, height)
        self.target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        if shrink == 1:  # depth first, so that each pixel is shaded once; not worth it when small
            self.target.color_mask = ((False,) * 4, (False,) * 4)
            self._render(1, moment)
            self.target.color_mask = ((True,) * 4, (True,) * 4)
        self._render(0, moment)
        view_box = (0, 0, width, height)
        rgba = np.frombuffer(self.target.read(view_box, components=4), np.uint8)
        rgba = rgba.reshape(height, width, 4)
        raw = self.target.read(view_box, components=1, attachment=1, dtype="f4")
        # GL's first row is at the bottom; the projection flips y, so rows come out top first.
        depth = np.frombuffer(raw, np.float32).reshape(height, width).copy()
        depth[depth <= 0] = np.inf
        moving = (rgba[..., 3] > 0) & (rgba[..., 3] < 255)
        return Picture(self._over_sky(rgba, camera), depth, moving)

    def _render(self, kind: int, moment: Moment) -> None:
        """kind: 0 shading, 1 depth only."""
        self.program["alpha"] = 1.0
        self.meshes[kind].render()
        self.program["alpha"] = ACTOR_ALPHA / 255
        for placement in moment.placements:
            self._actors[placement.actor].drawn[kind].render()

    def _set_camera(self, camera: RenderCamera, look: Shading) -> None:
        view, projection = _view_matrix(camera.pose), _projection_matrix(camera)
        for program in (self.program, self.depth_program):
            program["view"].write(_column_major(view))
            program["projection"].write(_column_major(projection))
        self.program["eye"] = tuple(camera.pose[:3, 3].tolist())
        self.program["exposure"] = look.exposure
        self.program["gloss"] = look.gloss
        self.program["contrast"] = look.contrast

    def _set_moment(self, moment: Moment) -> None:
        gains = [*moment.lamps, *[1.0] * MAX_LIGHTS][:MAX_LIGHTS]
        colors = [x.color * g for x, g in zip(_padded(self._lights), gains, strict=True)]
        self.program["light_color"].write(np.asarray(colors, "f4").tobytes())
        self.program["ambient"] = tuple((self.scene.ambient * moment.ambient).tolist())
        self.program["baked"] = moment.ambient
        self.program["key"] = 0.0 if self._lights else 0.6 * moment.ambient
        self.program["actors"] = bool(moment.placements)
        if moment.placements == self._placed:
            return
        self._placed = moment.placements
        for placement in moment.placements:
            self._actors[placement.actor].place(placement)
        shadows = [self._actors[p.actor].drawn[2] for p in moment.placements]
        self._draw_shadows(self._actor_target, ACTOR_SHADOW_SIZE, shadows)

    def _over_sky(self, rgba: np.ndarray, camera: RenderCamera) -> np.ndarray:
        image: np.ndarray = rgba[..., :3].copy()
        empty = rgba[..., 3] == 0
        if empty.any():
            height = len(image)
            up = (camera.centre[1] - (np.arange(height) + 0.5) / height) / camera.focal[1]
            rise = camera.pose[2, 2] - up * camera.pose[2, 1]
            share = np.clip(0.5 + rise / np.sqrt(1 + up**2), 0, 1)[:, None]
            rows = 255 * (self.scene.sky[0] * (1 - share) + self.scene.sky[1] * share)
            image[empty] = rows.astype(np.uint8)[np.nonzero(empty)[0]]
        return image

    def _texture_array(self, images: list[np.ndarray], size: int) -> moderngl.TextureArray:
        layers = np.stack(images) if images else np.zeros((1, size, size, 3), np.uint8)
        return self.ctx.texture_array((size, size, len(layers)), 3, layers.tobytes(), alignment=1)

    def _look_around(self, scene: Scene) -> Any:
        """A cube map of the scene's own light, seen from the middle; later draws mirror it.

        Scenes with baked light mirror nothing.
        """
        cube = self.ctx.texture_cube((MIRROR_SIZE, MIRROR_SIZE), 3, dtype="f2")
        cube.use(4)
        self.program["surroundings"] = 4
        self.program["mirrored"] = False
        corners = scene.vertices["position"]
        low, high = corners.min(axis=0), corners.max(axis=0)
        probe = (low + high) / 2
        self.program["probe"] = tuple(probe.tolist())
        self.program["box_low"], self.program["box_high"] = (
            tuple(low.tolist()),
            tuple(high.tolist()),
        )
        if scene.lightmaps:
            return cube
        target = self._mirror_target
        self.program["raw"] = True
        self._set_moment(STILL)
        for face, axes in enumerate(CUBE_FACES):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = np.array(axes, float).T, probe
            self._set_camera(RenderCamera(pose, (0.5, 0.5)), Shading(gloss=0.0))
            target.use()
            target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
            self._render(0, STILL)
            # a degenerate triangle's NaN would spread over the coarse levels
            seen = np.frombuffer(target.read(components=3, dtype="f2"), np.float16)
            cube.write(face, np.clip(np.nan_to_num(seen), 0, BRIGHTEST).astype("f2").tobytes())
        self.program["raw"] = False
        cube.build_mipmaps()
        cube.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self.program["mirrored"] = True
        return cube

    def _atlas(self, size: int) -> tuple[Any, Any]:
        """A 2 x 2 atlas of shadow maps, and the framebuffer that draws into it."""
        atlas = self.ctx.depth_texture((2 * size, 2 * size))
        atlas.compare_func = "<="
        return atlas, self.ctx.framebuffer([], atlas)

    def _draw_shadows(self, target: Any, size: int, meshes: list[Any]) -> None:
        """One tile of the atlas for each light."""
        target.use()
        target.viewport = (0, 0, 2 * size, 2 * size)
        target.clear(depth=1.0)
        for index, light in enumerate(self._lights):
            target.viewport = (index % 2 * size, index // 2 * size, size, size)
            self.shadow_program["light_matrix"].write(_column_major(_light_matrix(light)))
            for mesh in meshes:
                mesh.render()

    def _set_lights(self, lights: list[Light]) -> None:
        padded = _padded(lights)
        program = self.program
        program["light_count"] = len(lights)
        program["light_matrix"].write(b"".join(_column_major(_light_matrix(x)) for x in padded))
        for name, values in {
            "light_position": [x.position for x in padded],
            "light_direction": [x.direction for x in padded],
            # a window cuts its light itself
            "light_cosine": [-2.0 if x.window else _cosine(x) for x in padded],
            "pane_centre": [[*w.centre, w.bars] if (w := x.window) else NO_PANE for x in padded],
            "pane_right": [w.right if (w := x.window) else NO_PANE[:3] for x in padded],
            "pane_up": [w.up if (w := x.window) else NO_PANE[:3] for x in padded],
        }.items():
            program[name].write(np.asarray(values, "f4").tobytes())

    def _release(self) -> None:
        for item in self._scene_objects:
            item.release()  # type: ignore[attr-defined]
        self._scene_objects = []


def _padded(lights: list[Light]) -> list[Light]:
    dark = Light(np.zeros(3), np.array([0, 0, -1.0]), np.zeros(3))
    return [*lights, *[dark] * MAX_LIGHTS][:MAX_LIGHTS]


def _cosine(light: Light) -> float:
    return float(np.cos(np.radians(light.cone_degrees / 2)))


def _column_major(matrix: np.ndarray) -> bytes:
    result: bytes = matrix.T.astype("f4").tobytes()
    return result


def _view_matrix(pose: np.ndarray) -> np.ndarray:
    """World to camera, for a rigid 4 x 4 camera-to-world pose."""
    view = np.eye(4)
    view[:3, :3] = pose[:3, :3].T
    view[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return view


def _projection_matrix(camera: RenderCamera, far: float = 2000.0, near: float = NEAR) -> np.ndarray:
    """Optical axes to clip space; v grows with GL's y, so that row 0 is the image's top."""
    (fx, fy), (cx, cy) = camera.focal, camera.centre
    return np.array(
        [
            [2 * fx, 0, 2 * cx - 1, 0],
            [0, 2 * fy, 2 * cy - 1, 0],
            [0, 0, (far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, 1, 0],
        ]
    )


def _light_matrix(light: Light) -> np.ndarray:
    forward = light.direction / np.linalg.norm(light.direction)
    side = np.cross(forward, [0.0, 1.0, 0.0] if abs(forward[2]) > 0.9 else [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([side, np.cross(forward, side), forward], axis=1)
    pose[:3, 3] = light.position
    focal = 0.5 / np.tan(np.radians(min(light.cone_degrees, 150.0) / 2))
    near = NEAR
    if light.window is not None:
        near += float(((light.window.corners() - light.position) @ forward).max())
    projection = _projection_matrix(RenderCamera(pose, (focal, focal)), 40.0, near)
    result: np.ndarray = projection @ _view_matrix(pose)
    return result
