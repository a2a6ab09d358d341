"""Pictures of depth for people: curves, clouds, frames kept for a strip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


@dataclass(frozen=True)
class DepthSnapshot:
    """A frame kept for the strip, already small.

    image: h x w x 3 uint8 RGB. depth: h x w, NaN where the prediction is invalid.
    truth: h x w metres, NaN invalid; None without ground truth.
    """

    index: int
    image: np.ndarray
    depth: np.ndarray
    truth: np.ndarray | None


def snapshot(
    index: int, image: np.ndarray, depth: np.ndarray, truth: np.ndarray | None, width: int
) -> DepthSnapshot:
    """Arrays as in DepthSnapshot, of any size -> `width` pixels wide."""
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    depth = cv2.resize(depth.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
    if truth is not None:
        truth = cv2.resize(truth, size, interpolation=cv2.INTER_NEAREST)
    return DepthSnapshot(index, small, depth, truth)


def draw_cloud(
    points: np.ndarray, colours: np.ndarray, size: tuple[int, int] = (360, 480)
) -> np.ndarray:
    """A cloud seen from the right and above the camera that took it, nearer points in front.

    points: ... x 3 in the optical frame, not finite where invalid; colours: ... x 3 uint8 RGB.
    The unit does not matter. Returns size[0] x size[1] x 3 uint8 RGB, white where nothing is.
    """
    picture = np.full((*size, 3), 255, np.uint8)
    valid = np.isfinite(points).all(axis=-1)
    if not valid.any():
        return picture
    xyz, rgb = points[valid].astype(np.float64), colours[valid]
    middle = np.median(xyz[:, 2])
    yaw, pitch = np.radians(-28), np.radians(18)
    turn_y = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    turn_x = [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
    seen = (xyz / middle - [0, 0, 1]) @ (np.array(turn_x) @ np.array(turn_y)).T + [0, 0, 1.7]
    seen, rgb = seen[seen[:, 2] > 0.1], rgb[seen[:, 2] > 0.1]
    order = np.argsort(-seen[:, 2], kind="stable")  # far first, so that near ones paint over
    focal = 0.9 * size[1]
    columns, rows = (
        np.round(focal * seen[order, i] / seen[order, 2] + size[1 - i] / 2).astype(int)
        for i in (0, 1)
    )
    u = (columns[:, None] + [0, 1, 0, 1]).ravel()  # a point is 2 x 2 pixels
    v = (rows[:, None] + [0, 0, 1, 1]).ravel()
    inside = (u >= 0) & (u < size[1]) & (v >= 0) & (v < size[0])
    picture[v[inside], u[inside]] = np.repeat(rgb[order], 4, axis=0)[inside]
    return picture


def curves(
    panels: Mapping[str, Mapping[str, Sequence[float | None] | np.ndarray]], x_label: str = "frame"
) -> np.ndarray:
    """Panels (title -> line name -> a value per frame, None: a gap) as one RGB picture."""
    figure = Figure(figsize=(8.4, 2.3 * len(panels)), dpi=100, layout="constrained")
    axes = figure.subplots(len(panels), 1, squeeze=False, sharex=True)[:, 0]
    for axis, (title, lines) in zip(axes, panels.items(), strict=True):
        for name, values in lines.items():
            axis.plot(np.array(values, np.float64), label=name, linewidth=1.3)  # None: NaN
        axis.set_title(title, fontsize=10, loc="left")
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=8)
        if len(lines) > 1:
            axis.legend(fontsize=8, frameon=False)
    axes[-1].set_xlabel(x_label, fontsize=9)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    result: np.ndarray = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return result


def encode_picture(image: np.ndarray, suffix: str = ".png", quality: int = 88) -> bytes:
    """H x W x 3 uint8 RGB -> the bytes of a .png or .jpg file."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if suffix == ".jpg" else []
    done, data = cv2.imencode(suffix, np.ascontiguousarray(image[..., ::-1]), options)
    if not done:
        raise ValueError(f"cannot encode a picture of shape {image.shape} as {suffix}")
    return data.tobytes()
