"""Random camera and sensor effects, drawn once per clip and applied alike to its frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

PROCESSING = 1 << 20  # beside a look's seed: draws that leave the caller's generator alone
LUMA = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True)
class Appearance:
    """What happens to colours and sharpness. Everything is a value: applying it has no chance.

    colour: 3 x 3 on RGB in 0..1. gain, offset: per channel. gamma: exponent. blur: Gaussian sigma
    in pixels. motion: blur kernel or None. light: coarse field of gains. vignette: loss at the
    corners. noise: (shot, read) deviations. coarse: factor of a down- and upsampling.
    jpeg: quality or None. seed: of the noise. bloom: share of the brightest light that is spread
    around it. local: strength of a local tone mapping. sharpen: of an unsharp mask, which leaves
    halos.
    """

    colour: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    gamma: float
    blur: float
    motion: np.ndarray | None
    light: np.ndarray | None
    vignette: float
    noise: tuple[float, float]
    coarse: float
    jpeg: int | None
    seed: int
    bloom: float = 0.0
    local: float = 0.0
    sharpen: float = 0.0


@dataclass(frozen=True)
class Crop:
    """A crop window in normalised image coordinates (x0, y0, x1, y1) and a mirror flag."""

    window: tuple[float, float, float, float]
    flip: bool


def draw_crop(
    rng: np.random.Generator,
    source_aspect: float,
    aspect: float,
    smallest: float = 0.5,
    widths: tuple[float, float] = (0.0, math.inf),
) -> Crop:
    """A window of the given aspect (width / height) covering at least `smallest` of the fit.

    source_aspect: width / height of the frames. widths: the least and greatest width of the window,
    relative to the frame's, as far as the frame allows. The window lies anywhere inside the frame.
    """
    width, height = min(1.0, aspect / source_aspect), min(1.0, source_aspect / aspect)
    zoom = rng.uniform(smallest, 1.0) if rng.random() < 0.8 else 1.0
    zoom = min(1.0, max(min(zoom, widths[1] / width), widths[0] / width))
    width, height = width * zoom, height * zoom
    x, y = rng.uniform(0, 1 - width), rng.uniform(0, 1 - height)
    return Crop((x, y, x + width, y + height), bool(rng.random() < 0.5))


def crop_widths(fov: tuple[float, float] | None, focal: float) -> tuple[float, float]:
    """The least and greatest width of a window, relative to the frame's, for a field of view.

    fov: horizontal, degrees; None for no bound. focal: in units of the frame's width.
    """
    if fov is None:
        return 0.0, math.inf
    narrow, wide = (2 * focal * math.tan(math.radians(angle) / 2) for angle in fov)
    return narrow, wide


def clamped(depth: np.ndarray, factor: float) -> np.ndarray:
    """Depth, H x W, of at most `factor` times the depth that 1% of the known pixels are nearer
    than. What is unknown (NaN) or sky (inf) stays so."""
    known = depth[np.isfinite(depth) & (depth > 0)]
    if not known.size:
        return depth
    largest = np.quantile(known, 0.01) * factor
    result: np.ndarray = np.where(np.isfinite(depth), np.minimum(depth, largest), depth)
    return result.astype(depth.dtype)


def apply_crop(
    image: np.ndarray,
    depth: np.ndarray,
    intrinsics: np.ndarray,
    view: Crop,
    size: tuple[int, int],
    depth_size: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Crop, mirror and resize one frame; the image smoothly, the depth by nearest neighbour.

    image: H x W x 3 uint8; depth: H x W; intrinsics: normalised fx, fy, cx, cy; size and
    depth_size: (H, W) of the results. Returns image, depth and the new view's intrinsics.
    """
    height, width = image.shape[:2]
    left, right = round(view.window[0] * width), round(view.window[2] * width)
    top, bottom = round(view.window[1] * height), round(view.window[3] * height)
    shrinks = bottom - top > size[0]
    image = cv2.resize(
        image[top:bottom, left:right],
        (size[1], size[0]),
        interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR,
    )
    rows = top + ((np.arange(depth_size[0]) + 0.5) * (bottom - top) / depth_size[0]).astype(int)
    cols = left + ((np.arange(depth_size[1]) + 0.5) * (right - left) / depth_size[1]).astype(int)
    depth = depth[rows[:, None], cols[None, :]]
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    wide, high = (right - left) / width, (bottom - top) / height
    new = [fx / wide, fy / high, (cx - left / width) / wide, (cy - top / height) / high]
    if view.flip:
        image, depth, new[2] = image[:, ::-1], depth[:, ::-1], 1 - new[2]
    return np.ascontiguousarray(image), np.ascontiguousarray(depth), np.array(new, np.float32)


def mirrored_pose(pose: np.ndarray) -> np.ndarray:
    """4 x 4 of the mirrored camera in the mirrored world (x becomes -x in both)."""
    signs = np.array([-1.0, 1, 1, 1])
    result: np.ndarray = pose * signs[:, None] * signs
    return result


def draw_appearance(rng: np.random.Generator, strength: float = 1.0) -> Appearance:
    """A random look; strength 0 changes nothing, 1 is the full range."""

    def spread(amount: float) -> float:
        return float(rng.uniform(-amount, amount)) * strength

    def happens(probability: float, draws: np.random.Generator = rng) -> bool:
        return bool(draws.random() < probability * strength)

    saturation = 0.0 if happens(0.07) else 1 + spread(0.7)
    balance = np.exp(rng.normal(0, 0.12 * strength, 3))
    contrast = np.exp(spread(0.5))
    gain = (contrast * balance * np.exp(spread(0.35))).astype(np.float32)
    pivot = rng.uniform(0.3, 0.6)
    offset = np.full(3, pivot * (1 - contrast) + spread(0.12), np.float32)
    light = None
    if happens(0.4):
        light = np.exp(rng.normal(0, 0.35 * strength, (3, 4))).astype(np.float32)
    look = Appearance(
        colour=_colour_matrix(spread(0.35), saturation),
        gain=gain,
        offset=offset,
        gamma=float(np.exp(spread(0.45))),
        blur=float(rng.uniform(0.3, 1.3)) if happens(0.35) else 0.0,
        motion=_motion_kernel(rng) if happens(0.12) else None,
        light=light,
        vignette=float(rng.uniform(0.1, 0.5)) if happens(0.25) else 0.0,
        noise=(rng.uniform(0, 0.06), rng.uniform(0, 0.03)) if happens(0.5) else (0.0, 0.0),
        coarse=float(rng.uniform(1.3, 2.5)) if happens(0.2) else 1.0,
        jpeg=int(rng.integers(20, 95)) if happens(0.5) else None,
        seed=int(rng.integers(2**31)),
    )
    own = np.random.default_rng([look.seed, PROCESSING])
    return replace(
        look,
        bloom=float(own.uniform(0.1, 0.7)) if happens(0.25, own) else 0.0,
        local=float(own.uniform(0.1, 0.6)) if happens(0.3, own) else 0.0,
        sharpen=float(own.uniform(0.3, 2.0)) if happens(0.4, own) else 0.0,
    )


def apply_appearance(image: np.ndarray, look: Appearance, frame: int = 0) -> np.ndarray:
    """image H x W x 3 uint8 -> the same, as that camera would have seen it.

    frame: index in the clip; only the noise differs from frame to frame.
    """
    height, width = image.shape[:2]
    if look.coarse > 1:
        small = (max(1, round(width / look.coarse)), max(1, round(height / look.coarse)))
        image = cv2.resize(cv2.resize(image, small), (width, height))
    pixels: np.ndarray = image.astype(np.float32) / 255
    if look.light is not None:
        pixels *= cv2.resize(look.light, (width, height), interpolation=cv2.INTER_CUBIC)[..., None]
    if look.bloom > 0:
        pixels = pixels + look.bloom * 3 * _smooth(np.clip(pixels - 0.85, 0, None))
    if look.local > 0:
        level = _smooth(pixels).mean(axis=2, keepdims=True) + 0.05
        pixels = pixels * (level / level.mean()) ** -look.local
    matrix = look.colour * look.gain[:, None]
    pixels = cv2.transform(pixels, np.hstack([matrix, look.offset[:, None]]))
    if look.vignette > 0:
        x, y = np.linspace(-1, 1, width), np.linspace(-1, 1, height)
        kept = 1 - look.vignette * (x[None] ** 2 + y[:, None] ** 2) / 2
        pixels = pixels * kept.astype(np.float32)[..., None]
    if look.blur > 0:
        pixels = cv2.GaussianBlur(pixels, (0, 0), look.blur * width / 256 + 0.2)
    if look.motion is not None:
        pixels = cv2.filter2D(pixels, -1, look.motion)
    if look.sharpen > 0:
        pixels = pixels + look.sharpen * (pixels - cv2.GaussianBlur(pixels, (0, 0), 1.0))
    pixels = np.clip(pixels, 0, 1)
    if look.gamma != 1:
        pixels = cv2.pow(pixels, look.gamma)
    if look.noise != (0.0, 0.0):
        shot, read = look.noise
        noise = np.random.default_rng([look.seed, frame]).standard_normal(
            pixels.shape, dtype=np.float32
        )
        pixels = pixels + noise * (shot * np.sqrt(pixels) + read)
    result = np.clip(pixels * 255 + 0.5, 0, 255).astype(np.uint8)
    if look.jpeg is not None:
        _, data = cv2.imencode(".jpg", result, [cv2.IMWRITE_JPEG_QUALITY, look.jpeg])
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))
    return result


def _smooth(pixels: np.ndarray) -> np.ndarray:
    """A wide blur, by way of a small image."""
    height, width = pixels.shape[:2]
    small = cv2.resize(pixels, (24, 24), interpolation=cv2.INTER_AREA)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), 1.0), (width, height))


def _colour_matrix(hue: float, saturation: float) -> np.ndarray:
    """Rotation about the grey axis by `hue` radians, then a blend with the luminance."""
    axis = np.full(3, 1 / np.sqrt(3))
    cross = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / np.sqrt(3)
    turn = np.cos(hue) * np.eye(3) + np.sin(hue) * cross
    turn += (1 - np.cos(hue)) * np.outer(axis, axis)
    grey = np.tile(LUMA, (3, 1))
    mixed: np.ndarray = (saturation * np.eye(3) + (1 - saturation) * grey) @ turn
    return mixed.astype(np.float32)


def _motion_kernel(rng: np.random.Generator) -> np.ndarray:
    """A normalised line of random direction, 3 to 7 pixels long."""
    size = int(rng.choice([3, 5, 7]))
    kernel = np.zeros((size, size), np.float32)
    angle, centre = rng.uniform(0, np.pi), (size - 1) / 2
    reach = np.array([np.cos(angle), np.sin(angle)]) * centre
    start, end = np.round(centre - reach).astype(int), np.round(centre + reach).astype(int)
    cv2.line(kernel, start.tolist(), end.tolist(), 1.0)
    result: np.ndarray = kernel / kernel.sum()
    return result
