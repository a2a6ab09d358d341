"""Draws a Scene with OpenGL: colour, and depth exact to float32, in one pass.

Runs headless through EGL; Mesa's software rasteriser is enough. Shading: albedo times
(baked lightmap, or ambient plus shadow-mapped spot lights), tone mapped to sRGB.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np

from dyfn_core.data.worlds.scene import LIGHTMAP_SIZE, TEXTURE_SIZE, Light, Scene

MAX_LIGHTS = 4
SHADOW_SIZE = 768
NEAR = 0.05

VERTEX_SHADER = """
#version 330
uniform mat4 view; uniform mat4 projection;
in vec3 in_position; in vec3 in_normal; in vec2 in_uv; in vec3 in_color; in vec2 in_lightmap_uv;
in int in_texture; in int in_lightmap; in float in_emission;
invariant gl_Position;
out vec3 position; out vec3 normal; out vec2 uv; out vec3 color; out vec2 lightmap_uv;
out float depth; out float emission; flat out int layer; flat out int lightmap;
void main() {
    vec4 seen = view * vec4(in_position, 1.0);
    depth = seen.z;
    position = in_position; normal = in_normal; uv = in_uv; color = in_color;
    lightmap_uv = in_lightmap_uv; layer = in_texture; lightmap = in_lightmap;
    emission = in_emission;
    gl_Position = projection * seen;
}
"""

FRAGMENT_SHADER = """
#version 330
uniform sampler2DArray textures; uniform sampler2DArray lightmaps;
uniform sampler2DShadow shadows;
uniform vec3 eye; uniform vec3 ambient; uniform float exposure; uniform float gloss;
uniform int light_count; uniform mat4 light_matrix[MAX_LIGHTS];
uniform vec3 light_position[MAX_LIGHTS]; uniform vec3 light_direction[MAX_LIGHTS];
uniform vec3 light_color[MAX_LIGHTS]; uniform float light_cosine[MAX_LIGHTS];
in vec3 position; in vec3 normal; in vec2 uv; in vec3 color; in vec2 lightmap_uv;
in float depth; in float emission; flat in int layer; flat in int lightmap;
layout(location = 0) out vec4 out_color; layout(location = 1) out float out_depth;

float lit_share(int i, vec3 n) {
    // looked up a little off the surface, so that it does not shade itself
    vec4 p = light_matrix[i] * vec4(position + 0.03 * n, 1.0);
    if (p.w <= 0.0) return 0.0;
    vec3 q = p.xyz / p.w * 0.5 + 0.5;
    if (any(lessThan(q.xy, vec2(0.0))) || any(greaterThan(q.xy, vec2(1.0)))) return 0.0;
    float sum = 0.0; float step = 1.5 / SHADOW_SIZE; vec2 tile = vec2(i % 2, i / 2);
    for (int y = -1; y <= 1; y += 2) for (int x = -1; x <= 1; x += 2) {
        vec2 at = clamp(q.xy + vec2(x, y) * step, vec2(step), vec2(1.0 - step));
        sum += texture(shadows, vec3((at + tile) * 0.5, q.z - 0.0006));
    }
    return sum / 4.0;
}

void main() {
    vec3 albedo = texture(textures, vec3(uv, layer)).rgb;
    albedo *= albedo * color;
    vec3 n = normalize(normal); vec3 to_eye = normalize(eye - position);
    if (dot(n, to_eye) < 0.0) n = -n;
    vec3 light; vec3 shine = vec3(0.0);
    if (lightmap >= 0) {
        light = texture(lightmaps, vec3(lightmap_uv, lightmap)).rgb;
        light = 2.5 * light * light + 0.8 * light + ambient * 0.4;
    } else {
        light = ambient * (0.75 + 0.25 * n.z);
        for (int i = 0; i < light_count; i++) {
            vec3 l = light_position[i] - position; float d2 = dot(l, l); l *= inversesqrt(d2);
            float aim = -dot(l, light_direction[i]);
            float cone = smoothstep(light_cosine[i], light_cosine[i] + 0.15, aim);
            float facing = max(dot(n, l), 0.0);
            if (cone * facing <= 0.0) continue;
            vec3 incoming = light_color[i] * cone * lit_share(i, n) / (0.5 + d2);
            light += incoming * facing;
            float h = max(dot(n, normalize(l + to_eye)), 0.0);
            h *= h; h *= h; h *= h; h *= h; h *= h;
            shine += incoming * gloss * h;
        }
    }
    vec3 radiance = exposure * (albedo * (light + emission) + shine);
    radiance = radiance * (1.0 + radiance / 9.0) / (1.0 + radiance);
    out_color = vec4(sqrt(radiance), 1.0);
    out_depth = depth;
}
""".replace("MAX_LIGHTS", str(MAX_LIGHTS)).replace("SHADOW_SIZE", f"{SHADOW_SIZE}.0")

SHADOW_SHADER = """
#version 330
uniform mat4 light_matrix; in vec3 in_position;
void main() { gl_Position = light_matrix * vec4(in_position, 1.0); }
"""

DEPTH_SHADER = """
#version 330
uniform mat4 view; uniform mat4 projection; in vec3 in_position; invariant gl_Position;
void main() { vec4 seen = view * vec4(in_position, 1.0); gl_Position = projection * seen; }
"""

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
class Camera:
    """A pinhole camera. focal and centre are normalised by the image width and height.

    pose: 4 x 4 camera-to-world; camera axes are optical (x right, y down, z forward).
    """

    pose: np.ndarray
    focal: tuple[float, float]
    centre: tuple[float, float] = (0.5, 0.5)


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
        self.target: Any = self.ctx.framebuffer(
            [self.ctx.texture(shape, 4), self.ctx.texture(shape, 1, dtype="f4")],
            self.ctx.depth_renderbuffer(shape),
        )
        self._scene_objects: list[object] = []

    def load(self, scene: Scene) -> None:
        """Uploads the scene and draws its shadow maps; replaces the scene before."""
        self._release()
        self.scene = scene
        vertices = self.ctx.buffer(np.ascontiguousarray(scene.vertices).tobytes())
        indices = self.ctx.buffer(np.ascontiguousarray(scene.triangles, np.int32).tobytes())
        content = [(vertices, VERTEX_FORMAT, *VERTEX_NAMES)]
        self.mesh = self.ctx.vertex_array(self.program, content, indices, skip_errors=True)
        shadow_content = [(vertices, "3f 52x", "in_position")]
        self.depth_mesh = self.ctx.vertex_array(self.depth_program, shadow_content, indices)
        self.shadow_mesh = self.ctx.vertex_array(self.shadow_program, shadow_content, indices)
        textures = self._texture_array(scene.textures, TEXTURE_SIZE)
        textures.build_mipmaps()
        textures.filter = (moderngl.LINEAR_MIPMAP_NEAREST, moderngl.LINEAR)
        lightmaps = self._texture_array(scene.lightmaps, LIGHTMAP_SIZE)
        lightmaps.repeat_x = lightmaps.repeat_y = False
        shadows = self._draw_shadows(scene.lights[:MAX_LIGHTS])
        samplers: list[tuple[str, Any]] = [
            ("textures", textures),
            ("lightmaps", lightmaps),
            ("shadows", shadows),
        ]
        for unit, (name, texture) in enumerate(samplers):
            texture.use(unit)
            self.program[name] = unit
        self._set_lights(scene.lights[:MAX_LIGHTS])
        self.program["ambient"] = tuple(scene.ambient.tolist())
        self._scene_objects = [
            vertices, indices, self.mesh, self.depth_mesh, self.shadow_mesh,
            textures, lightmaps, shadows,
        ]  # fmt: skip

    def draw(
        self, camera: Camera, exposure: float = 1.0, gloss: float = 0.2, shrink: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Image h x w x 3 uint8 RGB and depth h x w float32 in metres, +inf for the sky.

        shrink: h x w is the renderer's size divided by it; for a cheap look before a full one.
        """
        height, width = self.size[0] // shrink, self.size[1] // shrink
        view, projection = _view_matrix(camera.pose), _projection_matrix(camera)
        for program in (self.program, self.depth_program):
            program["view"].write(_column_major(view))
            program["projection"].write(_column_major(projection))
        self.program["eye"] = tuple(camera.pose[:3, 3].tolist())
        self.program["exposure"] = exposure
        self.program["gloss"] = gloss
        self.target.use()
        self.target.viewport = (0, 0, width, height)
        self.target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        if shrink == 1:  # depth first, so that each pixel is shaded once; not worth it when small
            self.target.color_mask = ((False,) * 4, (False,) * 4)
            self.depth_mesh.render()
            self.target.color_mask = ((True,) * 4, (True,) * 4)
        self.mesh.render()
        view_box = (0, 0, width, height)
        rgba = np.frombuffer(self.target.read(view_box, components=4), np.uint8)
        raw = self.target.read(view_box, components=1, attachment=1, dtype="f4")
        # GL's first row is at the bottom; the projection flips y, so rows come out top first.
        depth = np.frombuffer(raw, np.float32).reshape(height, width).copy()
        depth[depth <= 0] = np.inf
        return self._over_sky(rgba.reshape(height, width, 4), camera), depth

    def _over_sky(self, rgba: np.ndarray, camera: Camera) -> np.ndarray:
        image = rgba[..., :3].copy()
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

    def _draw_shadows(self, lights: list[Light]) -> moderngl.Texture:
        """One tile of a 2 x 2 atlas for each light."""
        atlas = self.ctx.depth_texture((2 * SHADOW_SIZE, 2 * SHADOW_SIZE))
        atlas.compare_func = "<="
        target = self.ctx.framebuffer([], atlas)
        target.clear(depth=1.0)
        target.use()
        for index, light in enumerate(lights):
            tile = (index % 2 * SHADOW_SIZE, index // 2 * SHADOW_SIZE)
            target.viewport = (*tile, SHADOW_SIZE, SHADOW_SIZE)
            self.shadow_program["light_matrix"].write(_column_major(_light_matrix(light)))
            self.shadow_mesh.render()
        target.release()
        return atlas

    def _set_lights(self, lights: list[Light]) -> None:
        padded = [*lights, *[Light(np.zeros(3), np.array([0, 0, -1.0]), np.zeros(3))] * MAX_LIGHTS]
        padded = padded[:MAX_LIGHTS]
        program = self.program
        program["light_count"] = len(lights)
        program["light_matrix"].write(b"".join(_column_major(_light_matrix(x)) for x in padded))
        for name, values in {
            "light_position": [x.position for x in padded],
            "light_direction": [x.direction for x in padded],
            "light_color": [x.color for x in padded],
            "light_cosine": [np.cos(np.radians(x.cone_degrees / 2)) for x in padded],
        }.items():
            program[name].write(np.asarray(values, "f4").tobytes())

    def _release(self) -> None:
        for item in self._scene_objects:
            item.release()  # type: ignore[attr-defined]
        self._scene_objects = []


def _column_major(matrix: np.ndarray) -> bytes:
    return matrix.T.astype("f4").tobytes()


def _view_matrix(pose: np.ndarray) -> np.ndarray:
    """World to camera, for a rigid 4 x 4 camera-to-world pose."""
    view = np.eye(4)
    view[:3, :3] = pose[:3, :3].T
    view[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return view


def _projection_matrix(camera: Camera, far: float = 2000.0) -> np.ndarray:
    """Optical axes to clip space; v grows with GL's y, so that row 0 is the image's top."""
    (fx, fy), (cx, cy) = camera.focal, camera.centre
    return np.array(
        [
            [2 * fx, 0, 2 * cx - 1, 0],
            [0, 2 * fy, 2 * cy - 1, 0],
            [0, 0, (far + NEAR) / (far - NEAR), -2 * far * NEAR / (far - NEAR)],
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
    return _projection_matrix(Camera(pose, (focal, focal)), far=40.0) @ _view_matrix(pose)
