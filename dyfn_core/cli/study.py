"""dyfn-eval study: the paper's empirical study on the frames of any data, for any model."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator

import numpy as np
import torch
from tqdm import tqdm

from dyfn_core.cli.chosen_data import open_sequence, places
from dyfn_core.data.frames import FrameError, FrameSequence
from dyfn_core.evaluation.empirical_study import (
    draw_grid,
    grid_ranges,
    statistics_grid,
    write_grid,
)
from dyfn_core.evaluation.report.html import text_table
from dyfn_core.models.base import GeometryModel, Latent, image_to_batch
from dyfn_core.models.checkpoints import load_model

COMPLETE, UNUSABLE, PARTIAL = 0, 2, 3


def run(options: argparse.Namespace) -> int:
    """-> exit status. Raises ValueError, DataError or OSError for what cannot be used."""
    sequence = open_sequence(options)
    chosen = places(options, len(sequence))
    spread = np.unique(np.linspace(0, len(chosen) - 1, options.frames).round().astype(int))
    model = load_model(options.model, options.device, options.backend)
    lost: list[str] = []
    frames = tqdm([chosen[i] for i in spread], unit="frame", file=sys.stderr)
    latents = _latents(model, sequence, frames, options.num_tokens, lost)
    grid = statistics_grid(model, latents, tuple(options.factors))
    options.out.mkdir(parents=True, exist_ok=True)
    draw_grid(grid, options.out / "statistics_grid.png")
    write_grid(grid, options.out / "statistics_grid.csv", options.out / "statistics_grid.json")
    print(text_table(grid_ranges(grid)))
    print(
        f"{options.model} ({model.quantity}), {grid.frames} frames of {sequence.name}; figure and "
        f"tables in {options.out}"
    )
    if grid.unmasked:
        told = f"the model marks no pixel as valid in {grid.unmasked} frames: all were compared"
        print(f"dyfn-eval: {told}", file=sys.stderr)
    for text in lost:
        print(f"dyfn-eval: loss: {text}", file=sys.stderr)
    return PARTIAL if lost else COMPLETE


@torch.inference_mode()
def _latents(
    model: GeometryModel,
    sequence: FrameSequence,
    chosen: Iterable[int],
    num_tokens: int | None,
    lost: list[str],
) -> Iterator[Latent]:
    """Of the frames that can be read; the others are named in `lost`."""
    for place in chosen:
        try:
            image = sequence.read(place).image
        except FrameError as error:
            lost.append(str(error))
            continue
        yield model.encode(image_to_batch(image, model.device)[0], num_tokens)
