"""Quick scores during training: AbsRel and delta1 of single frames, aligned per frame."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from dyfn_core.data.frames import FrameError, FrameSequence
from dyfn_core.data.sequences import folder_frames
from dyfn_core.models.base import GeometryModel, image_to_batch
from dyfn_core.quantities import scored_quantity
from dyfn_core.scoring.protocols import SequenceScorer

logger = logging.getLogger(__name__)
SHORT_SIDE = 240  # frames are shrunk to this before they are encoded


@dataclass(frozen=True)
class Example:
    """image H x W x 3 uint8 and true depth H x W metres, not finite or <= 0 where unknown."""

    image: np.ndarray
    depth: np.ndarray


def spread_examples(sequences: list[FrameSequence], count: int) -> list[Example]:
    """`count` frames, evenly spread over all the frames of the sequences.

    Unreadable ones are left out with a warning; FrameError when none is readable.
    """
    places = [(sequence, index) for sequence in sequences for index in range(len(sequence))]
    chosen = np.unique(np.linspace(0, len(places) - 1, min(count, len(places))).round().astype(int))
    examples, problem = [], FrameError("there are no frames to validate on")
    for sequence, index in (places[place] for place in chosen):
        try:
            frame = sequence.read(index)
        except FrameError as error:
            logger.warning("not validated on: %s", error)
            problem = error
        else:
            examples.append(_small(frame.image, frame.depth))
    if not examples:
        raise problem
    return examples


def recording_examples(folder: Path, every: int = 20) -> list[Example]:
    """Every N-th frame with depth of an RGB-D folder, in the order of time; see folder_frames."""
    return [_small(image, depth) for image, depth in folder_frames(folder, every)]


def _small(image: np.ndarray, depth: np.ndarray) -> Example:
    factor = SHORT_SIDE / min(image.shape[:2])
    if factor < 1:
        size = (round(image.shape[1] * factor), round(image.shape[0] * factor))
        image = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA)
    size = (image.shape[1], image.shape[0])
    return Example(image, cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST))


@torch.no_grad()
def score(model: GeometryModel, examples: list[Example]) -> dict[str, float]:
    """Mean AbsRel and delta1 over the examples, image protocol (paper section 5).

    NaN when no example has enough known depth to be scored.
    """
    scorer = SequenceScorer(quantity=scored_quantity(model.quantity))
    for example in examples:
        affine = model.decode(model.encode(image_to_batch(example.image, model.device)[0]))
        scorer.push(affine.values[0].float().cpu().numpy(), example.depth)
    means = scorer.frames.metrics.means() or {}
    return {name: means.get(name, np.nan) for name in ("abs_rel", "delta1")}


@dataclass(frozen=True)
class Sequence:
    """Consecutive frames, encoded: latent T x C x h x w; depth T x H/2 x W/2 metres."""

    latent: torch.Tensor
    depth: torch.Tensor
    image_size: tuple[int, int]
    network_size: tuple[int, int]
