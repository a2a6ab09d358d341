"""The paper's empirical study: scale the latent's statistics and see what moves (section 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyfn_core.models.base import GeometryModel, Latent
from dyfn_core.models.stabilizer import EPSILON

FACTORS = (0.5, 0.625, 0.8, 1.0, 1.25, 1.6, 2.0)


@dataclass(frozen=True)
class StatisticsGrid:
    """Rows: factor a of the mean; columns: factor b of the deviation. Means over frames.

    scale, shift: the least squares fit original z = scale * changed z + shift; shift in units of
    the original's median depth. abs_rel: error of the changed z after it, against the original.
    """

    factors: tuple[float, ...]
    scale: np.ndarray
    shift: np.ndarray
    abs_rel: np.ndarray
    frames: int


def change_statistics(features: Tensor, a: float, b: float) -> Tensor:
    """B x C x h x w -> the same with mean a * mu and deviation b * sigma in every channel."""
    std, mean = torch.std_mean(features, dim=(-2, -1), keepdim=True)
    return (features - mean) / (std + EPSILON) * (b * std) + a * mean


@torch.inference_mode()
def statistics_grid(
    model: GeometryModel, latents: Sequence[Latent], factors: tuple[float, ...] = FACTORS
) -> StatisticsGrid:
    """Decode every latent with every pair of factors. Raises ValueError without latents."""
    if not latents:
        raise ValueError("no frame to change the statistics of")
    shape = (len(latents), len(factors), len(factors), 3)
    found = np.zeros(shape)
    for number, latent in enumerate(latents):
        original = _depth(model, latent)
        for row, a in enumerate(factors):
            for column, b in enumerate(factors):
                changed = replace(latent, features=change_statistics(latent.features, a, b))
                found[number, row, column] = _fit(_depth(model, changed), original)
    mean = found.mean(0)
    return StatisticsGrid(factors, mean[..., 0], mean[..., 1], mean[..., 2], len(latents))


def _depth(model: GeometryModel, latent: Latent) -> np.ndarray:
    depth = model.decode(latent).values.double().cpu().numpy()
    return np.asarray(depth).ravel()


def _fit(changed: np.ndarray, original: np.ndarray) -> tuple[float, float, float]:
    usable = np.isfinite(changed) & np.isfinite(original) & (original > 0)
    z, truth = changed[usable], original[usable]
    design = np.stack([z, np.ones_like(z)], -1)
    (scale, shift), *_ = np.linalg.lstsq(design, truth, rcond=None)
    error = np.abs(scale * z + shift - truth) / truth
    return float(scale), float(shift / np.median(truth)), float(error.mean())


def draw_grid(grid: StatisticsGrid, path: Path) -> None:
    """A PNG of the three maps over (a, b)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(12, 3.6), constrained_layout=True)
    parts = {"scale": grid.scale, "shift / median depth": grid.shift, "AbsRel": grid.abs_rel}
    labels = [f"{factor:g}" for factor in grid.factors]
    for axis, (name, values) in zip(axes, parts.items(), strict=True):
        image = axis.imshow(values, origin="lower", cmap="viridis")
        axis.set_title(name)
        axis.set_xlabel("b, factor of sigma")
        axis.set_ylabel("a, factor of mu")
        axis.set_xticks(range(len(labels)), labels)
        axis.set_yticks(range(len(labels)), labels)
        figure.colorbar(image, ax=axis)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
