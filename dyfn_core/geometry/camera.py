"""The pinhole camera: intrinsics, view rays, and focal and shift from an affine point map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

SAMPLES = 64
# Distances of the nearest sample after the shift that are tried first, in units of the depth
# range: falling, so that q rises.
_GRID = np.geomspace(1e4, 1e-4, 49)
OFF_CENTRE = 0.15  # of the width or height: a principal point farther from the middle is doubted
SAME_SHARE = 0.05  # of these two: what counts as the same place
FOCAL_RANGE = (0.1, 10.0)  # focal lengths in units of the image's width that are believed


def normalize_intrinsics(camera_matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Pixel intrinsics 3 x 3 -> normalised ones (float64), for an image of size (H, W).

    In pixels the centre of the first pixel is (0, 0) (ROS, OpenCV); normalised it is
    (0.5 / W, 0.5 / H). Raises ValueError unless it is a finite pinhole matrix with positive
    focal lengths and no skew.
    """
    k = check_camera_matrix(camera_matrix)
    height, width = size
    return np.array(
        [
            [k[0, 0] / width, 0.0, (k[0, 2] + 0.5) / width],
            [0.0, k[1, 1] / height, (k[1, 2] + 0.5) / height],
            [0.0, 0.0, 1.0],
        ]
    )


def pixel_intrinsics(intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Normalised intrinsics 3 x 3 -> pixels (float64) for (H, W); undoes normalize_intrinsics."""
    k = np.asarray(intrinsics, dtype=np.float64)
    height, width = size
    return np.array(
        [
            [k[0, 0] * width, 0.0, k[0, 2] * width - 0.5],
            [0.0, k[1, 1] * height, k[1, 2] * height - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )


def check_camera_matrix(camera_matrix: np.ndarray) -> np.ndarray:
    """The matrix as float64 3 x 3; ValueError, saying why, when it is no pinhole matrix."""
    k = np.asarray(camera_matrix, dtype=np.float64)
    if k.shape != (3, 3):
        raise ValueError(f"camera matrix must be 3 x 3, got shape {k.shape}")
    if not np.isfinite(k).all():
        raise ValueError(f"camera matrix has values that are not finite: {k.tolist()}")
    if k[0, 0] <= 0 or k[1, 1] <= 0:
        raise ValueError(
            f"camera matrix must have positive focal lengths, got fx={k[0, 0]:g}, fy={k[1, 1]:g} "
            "(an uncalibrated camera has K[0] == 0)"
        )
    if k[0, 1] != 0 or k[1, 0] != 0 or not np.array_equal(k[2], [0.0, 0.0, 1.0]):
        raise ValueError(f"camera matrix must be [fx 0 cx; 0 fy cy; 0 0 1], got {k.tolist()}")
    return k


def doubted_intrinsics(pixels: tuple[float, float, float, float], size: tuple[int, int]) -> str:
    """Why intrinsics cannot be of images of a size, as a sentence; "" when they can.

    pixels: fx, fy, cx, cy, the first pixel's centre at 0; size: (H, W). Wrong are a principal
    point outside the image and focal lengths outside FOCAL_RANGE, as of another resolution.
    """
    (height, width), (fx, fy, cx, cy) = size, pixels
    inside = -0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5
    low, high = (width * factor for factor in FOCAL_RANGE)
    if inside and low <= min(fx, fy) and max(fx, fy) <= high:
        return ""
    return (
        f"fx={fx:g} fy={fy:g} cx={cx:g} cy={cy:g} cannot be intrinsics in pixels of images of "
        f"{width} x {height}: expected the principal point inside and focal lengths of {low:g} "
        f"to {high:g}"
    )


def off_centre(pixels: tuple[float, float, float, float], size: tuple[int, int]) -> str:
    """Why intrinsics are unlikely to be of images of a size, as a sentence; "" when they may be.

    pixels, size: as of doubted_intrinsics. Cameras have their principal point near the middle;
    it is elsewhere in intrinsics of another resolution or of the image turned, and in a picture
    that was cropped.
    """
    (height, width), (fx, fy, cx, cy) = size, pixels
    across, down = (cx + 0.5) / width, (cy + 0.5) / height
    if max(abs(across - 0.5), abs(down - 0.5)) <= OFF_CENTRE:
        return ""
    told = (
        f"fx={fx:g} fy={fy:g} cx={cx:g} cy={cy:g} have the principal point {across:.0%} across and "
        f"{down:.0%} down images of {width} x {height}, expected near the middle"
    )
    if abs(across - down) <= SAME_SHARE:
        columns, rows = round(2 * cx + 1), round(2 * cy + 1)
        return f"{told}: intrinsics of {columns} x {rows}?"
    if abs((cx + 0.5) / height - 0.5) <= SAME_SHARE >= abs((cy + 0.5) / width - 0.5):
        return f"{told}: intrinsics of the image turned, {height} x {width}?"
    return f"{told}: a cropped picture, or intrinsics of another?"


def focal_from_fov(fov_x: float | Tensor, aspect: float, batch: int) -> Tensor:
    """Horizontal field of view in degrees -> focal relative to half the diagonal, B float64.

    aspect: W / H. Raises ValueError when a field of view is not between 0 and 180 degrees or
    there are neither one nor `batch` of them.
    """
    fov = torch.as_tensor(fov_x, dtype=torch.float64).cpu().reshape(-1)
    if len(fov) not in (1, batch):
        raise ValueError(f"fov_x must be one number or one per image ({batch}), got {len(fov)}")
    if not bool(((fov > 0) & (fov < 180)).all()):
        raise ValueError(f"fov_x must lie between 0 and 180 degrees, got {fov.tolist()}")
    span_x = aspect / math.hypot(aspect, 1.0)
    return (span_x / torch.tan(torch.deg2rad(fov) / 2)).expand(batch)


def intrinsics_from_focal(focal: Tensor, aspect: float) -> Tensor:
    """Focal relative to half the diagonal, B -> normalised intrinsics B x 3 x 3, centred."""
    diagonal = math.hypot(aspect, 1.0)
    intrinsics = focal.new_zeros((len(focal), 3, 3))
    intrinsics[:, 0, 0] = focal / 2 * diagonal / aspect
    intrinsics[:, 1, 1] = focal / 2 * diagonal
    intrinsics[:, :2, 2] = 0.5
    intrinsics[:, 2, 2] = 1.0
    return intrinsics


def uv_grid(
    size: tuple[int, int],
    aspect: float | None = None,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Tensor:
    """View-plane coordinates of the pixel centres, 2 x H x W, in units of half the diagonal.

    The image corners lie on the unit circle. aspect: W / H of the image when it is not that
    of the grid.
    """
    height, width = size
    aspect = width / height if aspect is None else aspect
    span_x = aspect / math.hypot(aspect, 1.0) * (width - 1) / width
    span_y = 1.0 / math.hypot(aspect, 1.0) * (height - 1) / height
    u = torch.linspace(-span_x, span_x, width, dtype=dtype, device=device)
    v = torch.linspace(-span_y, span_y, height, dtype=dtype, device=device)
    return torch.stack([u.expand(height, width), v[:, None].expand(height, width)])


def depth_to_points(depth: Tensor, intrinsics: Tensor) -> Tensor:
    """depth B x H x W, normalised intrinsics B x 3 x 3 -> points B x H x W x 3."""
    height, width = depth.shape[-2:]
    u = (torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5) / width
    v = (torch.arange(height, dtype=depth.dtype, device=depth.device) + 0.5) / height
    k = intrinsics.to(depth)
    x = (u - k[:, 0, 2, None]) / k[:, 0, 0, None]
    y = (v - k[:, 1, 2, None]) / k[:, 1, 1, None]
    points = depth.new_empty((*depth.shape, 3))  # filled by slices: half the time of a stack
    points[..., 0] = depth * x[:, None, :]
    points[..., 1] = depth * y[:, :, None]
    points[..., 2] = depth
    return points


def project(points: Tensor, intrinsics: Tensor) -> Tensor:
    """points B x ... x 3, normalised intrinsics B x 3 x 3 -> normalised pixels B x ... x 2."""
    k = intrinsics.to(points).reshape(-1, *([1] * (points.dim() - 2)), 3, 3)
    xy = points[..., :2] / points[..., 2:]
    return xy * torch.stack([k[..., 0, 0], k[..., 1, 1]], dim=-1) + k[..., :2, 2]


@dataclass(frozen=True)
class FocalShift:
    """What one point map says about its camera.

    focal: relative to half the image diagonal. shift: along z, in the point map's unit.
    solved: False when the map says nothing (fewer than two usable samples, or points that
        face away); focal is then 1 (or the known one) and shift 0.
    """

    focal: float
    shift: float
    solved: bool


def recover_focal_shift(
    points: Tensor, mask: Tensor | None = None, focal: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The camera of affine-invariant point maps (paper section 3, MoGe v1).

    points: B x H x W x 3; mask: B x H x W bool; focal: B, relative to half the diagonal, when
    it is known and only the shift is wanted. Minimises |focal * xy / (z + shift) - uv|^2 over
    64 x 64 nearest samples, to the exact optimum. Returns (focal, shift), each B float64 on
    the CPU; 1 (or the given focal) and 0 where the map says nothing.
    """
    samples, masks = sample(points, mask)
    uv = sampled_uv(points.shape[1], points.shape[2])
    found = [
        solve_focal_shift(xyz[usable], uv[usable], None if focal is None else float(focal[i]))
        for i, (xyz, usable) in enumerate(zip(samples, masks, strict=True))
    ]
    focals = torch.tensor([one.focal for one in found], dtype=torch.float64)
    return focals, torch.tensor([one.shift for one in found], dtype=torch.float64)


def sample(points: Tensor, mask: Tensor | None = None) -> tuple[np.ndarray, np.ndarray]:
    """64 x 64 nearest samples: (B x 4096 x 3 float64, B x 4096 bool: valid and finite)."""
    rows, columns = _nearest(points.shape[1]), _nearest(points.shape[2])
    few = points.detach()[:, rows[:, None], columns].cpu().numpy().astype(np.float64)
    usable = np.isfinite(few).all(axis=-1)
    if mask is not None:
        usable &= mask[:, rows[:, None], columns].cpu().numpy()
    return few.reshape(len(few), -1, 3), usable.reshape(len(few), -1)


def sampled_uv(height: int, width: int) -> np.ndarray:
    """View-plane coordinates of the samples, 4096 x 2, in units of half the diagonal."""
    diagonal = math.hypot(width, height)
    u = (2 * _nearest(width).numpy() + 1 - width) / diagonal
    v = (2 * _nearest(height).numpy() + 1 - height) / diagonal
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def _nearest(size: int) -> Tensor:
    return torch.arange(SAMPLES) * size // SAMPLES


def solve_focal_shift(xyz: np.ndarray, uv: np.ndarray, focal: float | None = None) -> FocalShift:
    """xyz N x 3, uv N x 2 (float64, finite) -> focal and shift, or the shift of a known focal.

    With q = 1 / (z_mean + shift) the projection is q * xy / (1 + q * (z - z_mean)), smooth on
    all q that keep every point before the camera. A coarse search over that whole range finds
    the valley, a bracketed root search of the derivative its floor.
    """
    unknown = FocalShift(1.0 if focal is None else focal, 0.0, False)
    if len(xyz) < 2:
        return unknown
    z = xyz[:, 2]
    centre, nearest = float(z.mean()), float(z.min())
    flat = centre - nearest <= 1e-9 * abs(centre)
    if flat and focal is None:  # a fronto-parallel plane: focal and shift say the same thing
        grid = np.array([1 / nearest]) if nearest > 0 else np.empty(0)
    else:
        unit = abs(centre) if flat else centre - nearest
        grid = 1 / (centre - nearest + max(unit, 1e-12) * _GRID)
    objective = _Objective(
        np.einsum("ij,ij->i", xyz[:, :2], uv),
        np.einsum("ij,ij->i", xyz[:, :2], xyz[:, :2]),
        z - centre,
        focal,
    )
    values = objective.on_grid(grid)
    if not len(grid) or not values.min() < 0:
        return unknown
    q = _valley(objective, grid, int(values.argmin()))
    return FocalShift(objective.focal(q), 1 / q - centre, True)


@dataclass(frozen=True)
class _Objective:
    """sum |f * q * xy / (1 + q dz) - uv|^2 - |uv|^2 as a function of q, f known or optimal."""

    along: np.ndarray
    square: np.ndarray
    dz: np.ndarray
    known: float | None

    def _sums(self, q: float) -> tuple[float, float, np.ndarray]:
        c = 1 / (1 + q * self.dz)
        return float(self.along @ c), float(self.square @ (c * c)), c

    def on_grid(self, q: np.ndarray) -> np.ndarray:
        """Values at every q, from a quarter of the samples: enough to find the valley."""
        step = 4 if len(self.dz) >= 1024 else 1
        c = 1 / (1 + q[:, None] * self.dz[::step])
        a, b = c @ self.along[::step], (c * c) @ self.square[::step]
        if self.known is not None:
            scale = self.known * q
            result: np.ndarray = scale * (scale * b - 2 * a)
            return result
        usable = (a > 0) & (b > 0)
        return np.where(usable, -a * a / np.where(usable, b, 1.0), 0.0)

    def slope(self, q: float) -> float:
        a, b, c = self._sums(q)
        w = self.dz * c
        da, db = -float(self.along @ (w * c)), -2 * float(self.square @ (w * c * c))
        if self.known is not None:
            scale = self.known * q
            return 2 * self.known * (scale * b - a) + scale * (scale * db - 2 * da)
        return a * (a * db / b - 2 * da) / b

    def focal(self, q: float) -> float:
        if self.known is not None:
            return self.known
        a, b, _ = self._sums(q)
        return a / b / q


def _valley(objective: _Objective, grid: np.ndarray, best: int) -> float:
    """The minimum next to grid[best]: the zero of the slope, bracketed by grid points."""
    low = high = best
    slope_low = slope_high = objective.slope(grid[best])
    while low > 0 and slope_low >= 0:
        low -= 1
        slope_low = objective.slope(grid[low])
    while high < len(grid) - 1 and slope_high <= 0:
        high += 1
        slope_high = objective.slope(grid[high])
    if not slope_low < 0 < slope_high:
        return float(grid[high] if slope_high < 0 else grid[low])
    return _illinois(objective, float(grid[low]), float(grid[high]), slope_low, slope_high)


def _illinois(
    objective: _Objective, low: float, high: float, slope_low: float, slope_high: float
) -> float:
    """The zero of a slope that is negative at low and positive at high."""
    last, side = math.inf, 0
    for _ in range(100):
        middle = (low * slope_high - high * slope_low) / (slope_high - slope_low)
        if abs(middle - last) <= 1e-13 * middle or not low < middle < high:
            return middle
        slope = objective.slope(middle)
        # An end that stays twice has its slope halved, which keeps it moving.
        if slope < 0:
            low, slope_low = middle, slope
            slope_high = slope_high / 2 if side < 0 else slope_high
            side = -1
        else:
            high, slope_high = middle, slope
            slope_low = slope_low / 2 if side > 0 else slope_low
            side = 1
        last = middle
    return middle


def valid_depth(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """H x W bool: where depth is finite, in front of the camera, and the model believes in it."""
    result: np.ndarray = mask & np.isfinite(depth) & (depth > 0)
    return result
