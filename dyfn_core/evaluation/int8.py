"""A step in 8 bits that is written only if it loses next to nothing on frames with depth."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from dyfn_core.data.frames import FrameSequence, RgbdFrame
from dyfn_core.evaluation.benchmarks.model_method import as_array
from dyfn_core.files import finished_file
from dyfn_core.models.base import GeometryModel, image_to_batch
from dyfn_core.models.export.int8 import CHOICES, quantize
from dyfn_core.models.export.parts import IMAGE, NEXT, affine_from, state_from, state_tensors
from dyfn_core.models.export.session import OnnxSession
from dyfn_core.models.export.step_file import StepInfo, info_of, write_step
from dyfn_core.prediction import StreamState
from dyfn_core.quantities import scored_quantity
from dyfn_core.scoring.protocols import SequenceScorer
from dyfn_core.stream.depth_stream import DepthStream

FRAMES = 96  # of the recording that are used, its first ones
HELD_BACK = 1 / 3  # of them, the last ones, which the ranges do not come from
FEWEST = 9
MOST_DELTA1, MOST_MEDIAN = 0.005, 0.01

Feed = dict[str, np.ndarray]


class Int8Error(ValueError):
    """No choice of layers in 8 bits loses little enough; the text has the numbers."""


@dataclass(frozen=True)
class Loss:
    """What 8 bits cost on the frames that were held back.

    choice: of int8.CHOICES. layers: how many are 8 bits. delta1, exact_delta1: with 8 bits and in
    float32, one alignment for all frames. median: of the relative differences of depth (or
    disparity) from float32's, over all pixels.
    """

    choice: str
    layers: int
    frames: int
    delta1: float
    exact_delta1: float
    median: float

    @property
    def accepted(self) -> bool:
        """Less than 0.5 points of delta1 and 1% of median depth lost."""
        lost = self.exact_delta1 - self.delta1
        return bool(lost < MOST_DELTA1 and self.median < MOST_MEDIAN)

    def __str__(self) -> str:
        return (
            f"{self.choice} ({self.layers} layers): delta1 {100 * self.delta1:.2f}% instead of "
            f"{100 * self.exact_delta1:.2f}%, median difference of depth {100 * self.median:.2f}%, "
            f"on {self.frames} frames"
        )


def write_int8_step(
    model: GeometryModel,
    path: Path,
    sequence: FrameSequence,
    num_tokens: int | None = None,
    stabilize: bool = True,
) -> tuple[StepInfo, Loss]:
    """Write a model's step with as many layers in 8 bits as the recording allows.

    Args:
        model: On the CPU, float32.
        path: The file, which is replaced if it exists.
        sequence: Frames with depth; the file is for images of their size.
        num_tokens: See write_step.
        stabilize: See write_step.

    Returns:
        What the file says of itself, and what it costs.

    Raises:
        Int8Error: Every choice loses too much; nothing is written.
        ValueError: Too few frames, or no depth to score with.
    """
    frames = [sequence.read(index) for index in range(min(len(sequence), FRAMES))]
    if len(frames) < FEWEST:
        raise ValueError(f"{sequence.name} has {len(frames)} frames, expected {FEWEST} or more")
    kept = len(frames) - round(len(frames) * HELD_BACK)
    refused = []
    with tempfile.TemporaryDirectory() as folder:
        step, found = Path(folder) / "float.onnx", Path(folder) / "int8.onnx"
        write_step(model, step, frames[0].image.shape[:2], num_tokens, stabilize)
        feeds, exact = _streamed(model, step, frames)
        for choice, beginnings in CHOICES.items():
            layers = quantize(step, found, feeds[:kept], beginnings)
            _, cheap = _streamed(model, found, frames)
            held = frames[kept:], exact[kept:], cheap[kept:]
            loss = _loss(choice, layers, scored_quantity(model.quantity), *held)
            if loss.accepted:
                with finished_file(path) as partial:
                    partial.write_bytes(found.read_bytes())
                return info_of(OnnxSession(path).metadata, str(path)), loss
            refused.append(str(loss))
    raise Int8Error(
        f"8 bits lose too much on {sequence.name}, at most {100 * MOST_DELTA1:g} points of delta1 "
        f"and {100 * MOST_MEDIAN:g}% of median depth are allowed: {'; '.join(refused)}"
    )


@torch.inference_mode()
def _streamed(
    model: GeometryModel, step: Path, frames: Sequence[RgbdFrame]
) -> tuple[list[Feed], list[np.ndarray]]:
    """Inputs of the step, and depth (or disparity), of each frame of one stream."""
    session = OnnxSession(step)
    info = info_of(session.metadata, str(step))
    begin = {"zeros": 0.0, "NaN": np.nan}
    state = (
        StreamState(
            **{
                name: torch.full(tuple(shape), begin[info.first_state[name]])
                for name, shape in info.state.items()
            }
        )
        if info.stabilized
        else None
    )
    stream = DepthStream(model, stabilize=info.stabilized)
    feeds, depths = [], []
    for frame in frames:
        image, _ = image_to_batch(frame.image)
        given = {IMAGE: model.prepare(image, info.num_tokens).pixels}
        given |= {} if state is None else state_tensors(state)
        feeds.append({name: value.numpy() for name, value in given.items()})
        found = session.run(given)
        state = None if state is None else state_from(found, NEXT)
        affine = affine_from(found, info.metres_of_focal)
        depths.append(as_array(stream.finish(affine, state)))
    return feeds, depths


def _loss(
    choice: str,
    layers: int,
    quantity: str,
    frames: Sequence[RgbdFrame],
    exact: Sequence[np.ndarray],
    cheap: Sequence[np.ndarray],
) -> Loss:
    scores = []
    for values in (cheap, exact):
        scorer = SequenceScorer(quantity=quantity)
        for one, frame in zip(values, frames, strict=True):
            scorer.push(one, frame.depth)
        score = scorer.video()
        if score is None:
            raise ValueError("the recording's last frames have no depth to score with")
        scores.append(score.metrics["delta1"])
    change = np.concatenate(
        [
            np.abs(a / b - 1)[np.isfinite(a) & np.isfinite(b)]
            for a, b in zip(cheap, exact, strict=True)
        ]
    )
    median = float(np.median(change)) if change.size else np.inf
    return Loss(choice, layers, len(frames), scores[0], scores[1], median)
