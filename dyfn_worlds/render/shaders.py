"""OpenGL programs of the renderer."""

from __future__ import annotations

MAX_LIGHTS = 4
SHADOW_SIZE = 768
ACTOR_SHADOW_SIZE = 256

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

FRAGMENT_SHADER = (
    """
#version 330
uniform sampler2DArray textures; uniform sampler2DArray lightmaps;
uniform sampler2DShadow shadows; uniform sampler2DShadow actor_shadows; uniform bool actors;
uniform vec3 eye; uniform vec3 ambient; uniform float exposure; uniform float gloss;
uniform float contrast; uniform float alpha; uniform float baked; uniform float key;
uniform int light_count; uniform mat4 light_matrix[MAX_LIGHTS];
uniform vec3 light_position[MAX_LIGHTS]; uniform vec3 light_direction[MAX_LIGHTS];
uniform vec3 light_color[MAX_LIGHTS]; uniform float light_cosine[MAX_LIGHTS];
uniform vec4 pane_centre[MAX_LIGHTS];  // w: bars across each pane; below 0 without a window
uniform vec3 pane_right[MAX_LIGHTS]; uniform vec3 pane_up[MAX_LIGHTS];
uniform samplerCube surroundings; uniform vec3 probe; uniform vec3 box_low; uniform vec3 box_high;
uniform bool mirrored; uniform bool raw;
in vec3 position; in vec3 normal; in vec2 uv; in vec3 color; in vec2 lightmap_uv;
in float depth; in float emission; flat in int layer; flat in int lightmap;
layout(location = 0) out vec4 out_color; layout(location = 1) out float out_depth;

float lit_share(int i, vec3 n) {
    // looked up a little off the surface, so that it does not shade itself
    vec4 p = light_matrix[i] * vec4(position + 0.03 * n, 1.0);
    if (p.w <= 0.0) return 0.0;
    vec3 q = p.xyz / p.w * 0.5 + 0.5;
    if (any(lessThan(q.xy, vec2(0.0))) || any(greaterThan(q.xy, vec2(1.0)))) return 1.0;
    float sum = 0.0; float step = 1.5 / SHADOW_SIZE; vec2 tile = vec2(i % 2, i / 2);
    for (int y = -1; y <= 1; y += 2) for (int x = -1; x <= 1; x += 2) {
        vec2 at = clamp(q.xy + vec2(x, y) * step, vec2(step), vec2(1.0 - step));
        sum += texture(shadows, vec3((at + tile) * 0.5, q.z - 0.0006));
    }
    if (actors) {
        float edge = 1.0 / ACTOR_SHADOW_SIZE;
        vec2 at = clamp(q.xy, vec2(edge), vec2(1.0 - edge));
        sum *= texture(actor_shadows, vec3((at + tile) * 0.5, q.z - 0.0006));
    }
    return sum / 4.0;
}

float through_window(int i) {
    // 1 where the way from the light goes through its window and past the window's bars
    if (pane_centre[i].w < 0.0) return 1.0;
    vec3 right = pane_right[i]; vec3 up = pane_up[i]; vec3 plane = cross(right, up);
    vec3 way = position - light_position[i];
    float t = dot(pane_centre[i].xyz - light_position[i], plane) / dot(way, plane);
    vec3 at = light_position[i] + t * way - pane_centre[i].xyz;
    vec2 q = vec2(dot(at, right) / dot(right, right), dot(at, up) / dot(up, up));
    if (t <= 0.0 || any(greaterThan(abs(q), vec2(1.0)))) return 0.0;
    vec2 bars = abs(fract(0.5 * (q + 1.0) * (pane_centre[i].w + 1.0) + 0.5) - 0.5);
    return pane_centre[i].w > 0.0 && min(bars.x, bars.y) < 0.05 ? 0.0 : 1.0;
}

vec3 reflected(vec3 way, float blur) {
    // what the room's own picture, taken at the probe, shows where this ray meets the room's box
    vec3 ends = (mix(box_low, box_high, step(0.0, way)) - position) / way;
    float t = max(min(min(ends.x, ends.y), ends.z), 0.0);
    return textureLod(surroundings, position + t * way - probe, blur).rgb;
}

void main() {
    vec3 albedo = texture(textures, vec3(uv, layer)).rgb;
    albedo *= albedo * color;
    vec3 n = normalize(normal); vec3 to_eye = normalize(eye - position);
    if (dot(n, to_eye) < 0.0) n = -n;
    vec3 light; vec3 shine = vec3(0.0);
    if (lightmap >= 0) {
        light = texture(lightmaps, vec3(lightmap_uv, lightmap)).rgb;
        light = baked * (2.5 * light * light + 0.8 * light) + ambient * 0.4;
    } else {
        light = ambient * (0.75 + 0.25 * n.z) + key * max(dot(n, vec3(0.4, 0.3, 0.866)), 0.0);
        if (mirrored) light = 0.45 * light + 0.8 * textureLod(surroundings, n, 5.0).rgb;
        float shiny = gloss * fract(float(layer) * 0.618);
        for (int i = 0; i < light_count; i++) {
            vec3 l = light_position[i] - position; float d2 = dot(l, l); l *= inversesqrt(d2);
            float aim = -dot(l, light_direction[i]);
            float cone = smoothstep(light_cosine[i], light_cosine[i] + 0.35, aim);
            float facing = max(dot(n, l), 0.0);
            cone *= through_window(i);
            if (cone * facing <= 0.0) continue;
            vec3 incoming = light_color[i] * cone * lit_share(i, n) / (0.5 + d2);
            light += incoming * facing;
            float h = max(dot(n, normalize(l + to_eye)), 0.0);
            h *= h; h *= h; h *= h; h *= h; h *= h;
            shine += incoming * shiny * h;
        }
        float graze = 1.0 - abs(dot(n, to_eye)); graze *= graze; graze *= graze;
        if (mirrored) {
            float blur = 4.0 * fract(float(layer) * 0.3247);
            float strength = (0.04 + 0.96 * graze) * min(2.0 * shiny, 1.0);
            shine += strength * reflected(reflect(-to_eye, n), blur);
        } else {
            shine += ambient * shiny * (0.05 + graze);
        }
    }
    out_depth = depth;
    vec3 radiance = albedo * (light + emission) + shine;
    if (raw) {
        out_color = vec4(radiance, 1.0);
        return;
    }
    radiance *= exposure;
    radiance = radiance * (1.0 + radiance / 9.0) / (1.0 + radiance);
    vec3 tone = sqrt(radiance);
    vec3 steep = clamp(tone * 1.12, 0.0, 1.0); steep *= steep * (3.0 - 2.0 * steep);
    out_color = vec4(mix(tone, steep, contrast), alpha);
}
""".replace("MAX_LIGHTS", str(MAX_LIGHTS))
    .replace("ACTOR_SHADOW_SIZE", f"{ACTOR_SHADOW_SIZE}.0")
    .replace("SHADOW_SIZE", f"{SHADOW_SIZE}.0")
)

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
