"""Clouds that can be turned in a report: packed small, drawn by a few lines of WebGL."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from dyfn_core.evaluation.reconstruction.cloud_pictures import CEILING, draw_fused, upright
from dyfn_core.evaluation.report.pictures import encode_picture
from dyfn_core.geometry.registration import Similarity

POINTS = 45_000  # of all clouds of a view; 9 bytes each
STEPS = 65_535  # a coordinate has 16 bits
ROOM = 0.25  # of the box, beyond the inner 98 % of the points in each direction
PATH_POINTS = 400
LINES = 10  # of the floor's grid, at most about so many across


@dataclass(frozen=True)
class PointCloud:
    """points: N x 3 in the unit of the view; colours: N x 3 uint8 RGB."""

    points: np.ndarray
    colours: np.ndarray


@dataclass(frozen=True)
class CloudView:
    """Clouds of one world, shown one at a time from one point of view.

    clouds: name -> cloud; one has a point at least. poses: of the cameras, to the same world, whose
    path is drawn and whose images say what is up; none: the cloud is in a camera's optical frame.
    unit: of the points, "m", or "" when they are right up to scale.
    """

    clouds: Mapping[str, PointCloud]
    poses: Sequence[Similarity] = ()
    unit: str = "m"
    alt: str = "cloud"


def cloud_html(view: CloudView) -> str:
    """The figure: a picture, which the script replaces where the browser has WebGL."""
    first = max(view.clouds.values(), key=lambda cloud: len(cloud.points))
    picture = draw_fused(first.points, first.colours, view.poses, oblique=True)
    poster = base64.b64encode(encode_picture(picture, ".jpg")).decode("ascii")
    buttons = "".join(f'<button type="button">{escape(name)}</button>' for name in view.clouds)
    packed = json.dumps(_packed(view), separators=(",", ":")).replace("<", "\\u003c")
    return (
        f'<figure class="cloud" data-cloud><div class="tools">{buttons}<label>'
        '<input type="checkbox" checked> without the top tenth</label></div>'
        f'<img alt="{escape(view.alt, quote=True)}" src="data:image/jpeg;base64,{poster}">'
        f'<canvas tabindex="0" role="img" aria-label="{escape(view.alt, quote=True)}"></canvas>'
        '<p class="note">drag: turn; shift and drag: move; wheel (after a click) or two fingers: '
        f'zoom<span></span></p><script type="application/json">{packed}</script></figure>'
    )


def _packed(view: CloudView) -> dict[str, Any]:
    """What the script draws: coordinates of the upright world, as 16 bits of a common box."""
    turn = upright(view.poses)
    clouds = {name: _thinned(cloud, len(view.clouds), turn) for name, cloud in view.clouds.items()}
    joined = np.concatenate([cloud.points for cloud in clouds.values()])
    path = np.array([p.translation for p in view.poses]).reshape(-1, 3) @ turn.T
    path = path[:: math.ceil(max(len(path), 1) / PATH_POINTS)]
    low, high = np.percentile(joined, [1, 99], axis=0)
    extent = float(max((high - low).max(), 1e-6))
    low, high = low - ROOM * extent, high + ROOM * extent
    step = float((high - low).max()) / STEPS
    heights = np.percentile(joined[:, 2], [2, CEILING])
    return {
        "clouds": [
            {"name": name, **_encoded(cloud, low, high, step)} for name, cloud in clouds.items()
        ],
        "low": _rounded(low),
        "step": step,
        "extent": extent,
        "centre": _rounded(np.median(joined, axis=0)),
        "floor": float(heights[0]),
        "top": float(heights[1]),
        "grid": _nice(extent / LINES),
        "unit": view.unit,
        "path": _rounded(path.ravel()),
    }


def _thinned(cloud: PointCloud, clouds: int, turn: np.ndarray) -> PointCloud:
    """An even share of POINTS, drawn at random; turned upright."""
    count = min(len(cloud.points), POINTS // clouds)
    kept = np.random.default_rng(0).permutation(len(cloud.points))[:count]
    return PointCloud(cloud.points[kept] @ turn.T, cloud.colours[kept])


def _encoded(cloud: PointCloud, low: np.ndarray, high: np.ndarray, step: float) -> dict[str, Any]:
    """Points inside the box: little-endian uint16 x 3 of all, then uint8 x 3 of all."""
    inside = ((cloud.points >= low) & (cloud.points <= high)).all(axis=1)
    places = np.round((cloud.points[inside] - low) / step).clip(0, STEPS).astype("<u2")
    data = places.tobytes() + np.ascontiguousarray(cloud.colours[inside], np.uint8).tobytes()
    return {"count": int(inside.sum()), "data": base64.b64encode(data).decode("ascii")}


def _rounded(values: np.ndarray) -> list[float]:
    return [float(f"{value:.6g}") for value in values]


def _nice(value: float) -> float:
    """The next larger of 1, 2, 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(f"{next(m for m in (1, 2, 5, 10) if m * power >= value) * power:.6g}")


# Without WebGL, or without script, the picture stays.
CLOUD_SCRIPT = """
document.querySelectorAll("figure[data-cloud]").forEach(function (figure) {
  var data = JSON.parse(figure.querySelector("script").textContent);
  var canvas = figure.querySelector("canvas"), buttons = figure.querySelectorAll("button");
  var cut = figure.querySelector("input");
  var gl = canvas.getContext("webgl", { antialias: true });
  if (!gl) return;
  figure.classList.add("live");
  figure.querySelector("p span").textContent =
    "; grid: " + data.grid + (data.unit ? " " + data.unit : " (depth is right up to scale)");
  function shader(kind, text) {
    var made = gl.createShader(kind);
    gl.shaderSource(made, text); gl.compileShader(made);
    return made;
  }
  var program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER,
    "attribute vec3 place, colour; uniform mat4 view; uniform vec3 low; uniform float step;" +
    "uniform float size, top; varying vec3 painted; void main() { vec3 at = low + place * step;" +
    "gl_Position = view * vec4(at, 1.0); gl_PointSize = clamp(size / gl_Position.w, 1.5, 24.0);" +
    "if (at.z > top) gl_Position = vec4(9.0, 9.0, 9.0, 1.0); painted = colour; }"));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER, "precision mediump float;" +
    "varying vec3 painted; void main() { gl_FragColor = vec4(painted, 1.0); }"));
  gl.linkProgram(program); gl.useProgram(program);
  var at = {}, spot = gl.getAttribLocation(program, "place");
  var hue = gl.getAttribLocation(program, "colour");
  ["view", "low", "step", "size", "top"].forEach(function (name) {
    at[name] = gl.getUniformLocation(program, name);
  });
  function buffer(bytes) {
    var made = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, made); gl.bufferData(gl.ARRAY_BUFFER, bytes, gl.STATIC_DRAW);
    return made;
  }
  var clouds = data.clouds.map(function (cloud) {
    var text = atob(cloud.data), bytes = new Uint8Array(text.length);
    for (var i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return { count: cloud.count, buffer: buffer(bytes) };
  });
  var lines = [], reach = data.extent * 0.75, grid = data.grid, mid = data.centre;
  var x0 = Math.floor((mid[0] - reach) / grid), x1 = Math.ceil((mid[0] + reach) / grid);
  var y0 = Math.floor((mid[1] - reach) / grid), y1 = Math.ceil((mid[1] + reach) / grid), i;
  for (i = x0; i <= x1; i++) lines.push(i * grid, y0 * grid, data.floor, i * grid, y1 * grid,
    data.floor);
  for (i = y0; i <= y1; i++) lines.push(x0 * grid, i * grid, data.floor, x1 * grid, i * grid,
    data.floor);
  var floor = buffer(new Float32Array(lines)), path = buffer(new Float32Array(data.path));
  var yaw = -0.35, pitch = 0.6, away = data.extent * 1.25, target = data.centre.slice(), shown = 0;
  function axes() {
    var cy = Math.cos(yaw), sy = Math.sin(yaw), cp = Math.cos(pitch), sp = Math.sin(pitch);
    return { right: [cy, sy, 0], up: [-sy * sp, cy * sp, cp], back: [sy * cp, -cy * cp, sp] };
  }
  function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
  function view(width, height) {
    var a = axes(), f = 1.9, near = away / 100, far = away * 10 + data.extent * 4;
    var p = f * Math.min(1, height / width), q = p * width / height;
    var z = (far + near) / (near - far), w = 2 * far * near / (near - far);
    var t = [-dot(a.right, target), -dot(a.up, target), -dot(a.back, target) - away];
    var m = [], r = a.right, u = a.up, b = a.back;
    for (var i = 0; i < 3; i++) m.push(p * r[i], q * u[i], z * b[i], -b[i]);
    m.push(p * t[0], q * t[1], z * t[2] + w, -t[2]);
    return new Float32Array(m);
  }
  function strokes(made, count, kind, red, green, blue) {
    gl.bindBuffer(gl.ARRAY_BUFFER, made);
    gl.uniform3f(at.low, 0, 0, 0); gl.uniform1f(at.step, 1); gl.uniform1f(at.top, 1e30);
    gl.disableVertexAttribArray(hue); gl.vertexAttrib3f(hue, red, green, blue);
    gl.vertexAttribPointer(spot, 3, gl.FLOAT, false, 0, 0);
    gl.drawArrays(kind, 0, count);
  }
  function draw() {
    var ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
    canvas.width = Math.round(box.width * ratio); canvas.height = Math.round(box.height * ratio);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.094, 0.102, 0.122, 1); gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(at.view, false, view(canvas.width, canvas.height));
    gl.enableVertexAttribArray(spot);
    strokes(floor, lines.length / 3, gl.LINES, 0.28, 0.3, 0.34);
    strokes(path, data.path.length / 3, gl.LINE_STRIP, 1, 0.59, 0.16);
    var cloud = clouds[shown];
    gl.bindBuffer(gl.ARRAY_BUFFER, cloud.buffer);
    gl.uniform3fv(at.low, data.low); gl.uniform1f(at.step, data.step);
    gl.uniform1f(at.top, cut.checked ? data.top : 1e30);
    gl.uniform1f(at.size, canvas.width * data.extent * 2.2 / Math.sqrt(cloud.count));
    gl.enableVertexAttribArray(hue);
    gl.vertexAttribPointer(spot, 3, gl.UNSIGNED_SHORT, false, 6, 0);
    gl.vertexAttribPointer(hue, 3, gl.UNSIGNED_BYTE, true, 3, cloud.count * 6);
    gl.drawArrays(gl.POINTS, 0, cloud.count);
    buttons.forEach(function (b, i) { b.setAttribute("aria-pressed", i === shown); });
  }
  function move(dx, dy) {
    var a = axes(), s = away / canvas.getBoundingClientRect().width;
    for (var i = 0; i < 3; i++) target[i] += (a.up[i] * dy - a.right[i] * dx) * s;
  }
  var held = new Map();
  function spread() {
    var two = Array.from(held.values());
    return Math.hypot(two[0].x - two[1].x, two[0].y - two[1].y);
  }
  canvas.addEventListener("pointerdown", function (event) {
    canvas.setPointerCapture(event.pointerId); canvas.focus({ preventScroll: true });
    held.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", function (event) {
    var last = held.get(event.pointerId);
    if (!last) return;
    var dx = event.clientX - last.x, dy = event.clientY - last.y;
    var before = held.size === 2 ? spread() : 0;
    held.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (held.size === 2) { away *= before / Math.max(spread(), 1); move(dx / 2, dy / 2); }
    else if (event.shiftKey || event.buttons === 2) move(dx, dy);
    else { yaw -= dx * 0.008; pitch = Math.max(-1.5, Math.min(1.55, pitch + dy * 0.008)); }
    draw();
  });
  ["pointerup", "pointercancel"].forEach(function (name) {
    canvas.addEventListener(name, function (event) { held.delete(event.pointerId); });
  });
  canvas.addEventListener("contextmenu", function (event) { event.preventDefault(); });
  canvas.addEventListener("wheel", function (event) {
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    away *= Math.exp(event.deltaY * 0.001); draw();
  }, { passive: false });
  canvas.addEventListener("keydown", function (event) {
    var turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1],
      ArrowDown: [0, -0.1] }[event.key];
    if (event.key === "+") away *= 0.9; else if (event.key === "-") away /= 0.9;
    else if (!turn) return;
    if (turn) { yaw += turn[0]; pitch = Math.max(-1.5, Math.min(1.55, pitch + turn[1])); }
    event.preventDefault(); draw();
  });
  buttons.forEach(function (button, i) {
    button.addEventListener("click", function () { shown = i; draw(); });
  });
  cut.addEventListener("change", draw); window.addEventListener("resize", draw);
  draw();
});
"""
