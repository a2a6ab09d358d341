"""The paper's empirical study: scale the latent's statistics and see what moves (section 1)."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyfn_core.evaluation.choices import FACTORS
from dyfn_core.evaluation.report.html import Table
from dyfn_core.models.base import Affine, AffineDisparity, GeometryModel, Latent
from dyfn_core.models.dyfn import EPSILON


@dataclass(frozen=True)
class StatisticsGrid:
    """Rows: factor a of the mean; columns: factor b of the deviation. Means over frames.

    scale, shift: the least squares fit original z = scale * changed z + shift; shift in units of
    the original's median depth. abs_rel: error of the changed z after it, against the original.
    For z stands the disparity of models that give it. Where the model gives no geometry for the
    original latent, as in the sky, nothing is compared. unmasked: frames where the model gives none
    at all, as an untrained one, and every pixel is compared.
    """

    factors: tuple[float, ...]
    scale: np.ndarray
    shift: np.ndarray
    abs_rel: np.ndarray
    frames: int
    unmasked: int


def change_statistics(features: Tensor, a: float, b: float) -> Tensor:
    """B x C x h x w -> the same with mean a * mu and deviation b * sigma in every channel."""
    std, mean = torch.std_mean(features, dim=(-2, -1), keepdim=True)
    return (features - mean) / (std + EPSILON) * (b * std) + a * mean


@torch.inference_mode()
def statistics_grid(
    model: GeometryModel, latents: Iterable[Latent], factors: tuple[float, ...] = FACTORS
) -> StatisticsGrid:
    """Decode every latent with every pair of factors; one latent is held at a time.

    Raises ValueError without latents, or for factors that are not positive.
    """
    if not factors or not all(np.isfinite(f) and f > 0 for f in factors):
        raise ValueError(f"factors of the statistics must be above 0, got {factors}")
    total, frames = np.zeros((len(factors), len(factors), 3)), 0
    unmasked = 0
    for latent in latents:
        decoded = model.decode(latent)
        valid = valid_pixels(decoded, model).cpu().numpy()
        unmasked += not valid.any()
        original = np.where(valid if valid.any() else True, _values(decoded), np.nan)
        for row, a in enumerate(factors):
            for column, b in enumerate(factors):
                changed = replace(latent, features=change_statistics(latent.features, a, b))
                total[row, column] += _fit(_values(model.decode(changed)), original)
        frames += 1
    if not frames:
        raise ValueError("no frame to change the statistics of")
    mean = total / frames
    return StatisticsGrid(
        tuple(factors), mean[..., 0], mean[..., 1], mean[..., 2], frames, unmasked
    )


def valid_pixels(decoded: Affine, model: GeometryModel) -> Tensor:
    """B x H x W bool: where the model gives geometry at all, which sky is not."""
    if isinstance(decoded, AffineDisparity):
        return decoded.disparity > 0
    return (decoded.mask > model.mask_threshold) & (decoded.values > 0)


def _values(decoded: Affine) -> np.ndarray:
    return np.asarray(decoded.values.double().cpu().numpy())


def _fit(changed: np.ndarray, original: np.ndarray) -> tuple[float, float, float]:
    usable = np.isfinite(changed) & np.isfinite(original) & (original > 0)
    z, truth = changed[usable], original[usable]
    design = np.stack([z, np.ones_like(z)], -1)
    (scale, shift), *_ = np.linalg.lstsq(design, truth, rcond=None)
    error = np.abs(scale * z + shift - truth) / truth
    return float(scale), float(shift / np.median(truth)), float(error.mean())


def grid_ranges(grid: StatisticsGrid) -> Table:
    """The range of each quantity over the grid, and where nothing is changed (if that is in it)."""
    rows: list[list[str | float | int | None]] = []
    for name, values in _maps(grid).items():
        middle = None
        if 1.0 in grid.factors:
            centre = grid.factors.index(1.0)
            middle = float(values[centre, centre])
        rows.append([name, float(values.min()), float(values.max()), middle])
    return Table(("over a, b", "lowest", "highest", "a = b = 1"), rows)


def write_grid(grid: StatisticsGrid, csv_path: Path, json_path: Path) -> None:
    """A row per pair of factors as CSV; the whole grid as JSON (rows: a, columns: b)."""
    with csv_path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("a", "b", "scale", "shift", "abs_rel"))
        for row, a in enumerate(grid.factors):
            for column, b in enumerate(grid.factors):
                at = (row, column)
                writer.writerow((a, b, grid.scale[at], grid.shift[at], grid.abs_rel[at]))
    content = {
        "factors": list(grid.factors),
        "frames": grid.frames,
        "unmasked_frames": grid.unmasked,
        "scale": grid.scale.tolist(),
        "shift_over_median_depth": grid.shift.tolist(),
        "abs_rel": grid.abs_rel.tolist(),
    }
    json_path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _maps(grid: StatisticsGrid) -> dict[str, np.ndarray]:
    return {
        "scale": grid.scale,
        "shift / median depth": grid.shift,
        "AbsRel after alignment": grid.abs_rel,
    }


def draw_grid(grid: StatisticsGrid, path: Path) -> None:
    """A PNG of the three maps over (a, b)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(13.5, 4.2), constrained_layout=True)
    labels = [f"{factor:g}" for factor in grid.factors]
    for axis, (name, values) in zip(axes, _maps(grid).items(), strict=True):
        image = axis.imshow(values, origin="lower", cmap="viridis")
        axis.set_title(name)
        axis.set_xlabel("b, factor of the deviation")
        axis.set_ylabel("a, factor of the mean")
        axis.set_xticks(range(len(labels)), labels)
        axis.set_yticks(range(len(labels)), labels)
        for (row, column), value in np.ndenumerate(values):
            dark = image.norm(value) < 0.6
            axis.text(
                column,
                row,
                f"{value:.2f}",
                ha="center",
                va="center",
                fontsize=7,
                color="white" if dark else "black",
            )
        figure.colorbar(image, ax=axis)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
