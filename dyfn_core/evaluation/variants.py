"""A model scored with every way to stabilize it: encoded once, decoded for each.

What a learned DyFN has to beat stands beside every result: the base, a moving average of the
latent's statistics, those of the first frame, a ramp, a constant. A gap between the image and the
video protocol proves nothing alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from dyfn_core.models.base import GeometryModel, Latent, image_to_batch
from dyfn_core.models.controls import decode_with, latent_controls
from dyfn_core.models.dyfn import DyFN
from dyfn_core.prediction import StreamState
from dyfn_core.quantities import scored_quantity
from dyfn_core.scoring.protocols import CONTROLS
from dyfn_core.scoring.variants import VariantScore, VariantScorers, mean_scores

LATENT_CONTROLS = ("ema", "frozen")
BASE_ROWS = (*CONTROLS, "base", *LATENT_CONTROLS)
VARIANTS = (*BASE_ROWS, "dyfn")

EncodedFrame = tuple[Latent, np.ndarray]
Stabilizers = Mapping[str, DyFN | None]
FrameSource = Callable[[], Iterable[tuple[np.ndarray, np.ndarray]]]


@dataclass(frozen=True)
class EncodedSequence:
    """A sequence after the encoder: latents of its frames, and true depth H x W metres each."""

    name: str
    latents: list[Latent]
    depth: list[np.ndarray]

    def __iter__(self) -> Iterator[EncodedFrame]:
        return zip(self.latents, self.depth, strict=True)


def encode(
    model: GeometryModel,
    frames: Iterable[tuple[np.ndarray, np.ndarray]],
    num_tokens: int | None = None,
) -> Iterator[EncodedFrame]:
    """Encode frames one at a time.

    Args:
        model: its stabilizer is not used.
        frames: RGB H x W x 3 uint8 and depth h x w metres (not finite or <= 0: unknown).
        num_tokens: None for the model's default.

    Yields:
        The latent and the true depth of each frame.
    """
    for image, truth in frames:
        with torch.inference_mode():
            latent = model.encode(image_to_batch(image, model.device)[0], num_tokens)
        yield latent, truth


def encode_sequence(
    model: GeometryModel, name: str, frames: Iterable[tuple[np.ndarray, np.ndarray]]
) -> EncodedSequence:
    """Encode frames (see encode) and keep them in memory."""
    latents, depths = [], []
    for latent, truth in encode(model, frames):
        latents.append(latent)
        depths.append(np.where(np.isfinite(truth), truth, np.nan).astype(np.float32))
    return EncodedSequence(name, latents, depths)


def decode(
    model: GeometryModel, encoded: Iterable[EncodedFrame], stabilizers: Stabilizers
) -> Iterator[tuple[dict[str, np.ndarray], np.ndarray]]:
    """Decode each latent once per stabilizer (None: as it is).

    Yields:
        By the stabilizers' names what the decoder gives, z or disparity without recovered focal
        length or shift, H x W, and the true depth.
    """
    states: dict[str, StreamState | None] = dict.fromkeys(stabilizers)
    for latent, truth in encoded:
        found = {}
        for name, stabilizer in stabilizers.items():
            with torch.inference_mode():
                affine, states[name] = decode_with(model, stabilizer, latent, states[name])
            found[name] = affine.values[0].float().cpu().numpy()
        yield found, truth


def score_encoded(
    model: GeometryModel,
    sequences: Iterable[tuple[str, Iterable[EncodedFrame]]],
    stabilizers: Stabilizers,
    controls: bool = False,
) -> dict[str, VariantScore]:
    """Score the decoder's output for each stabilizer.

    Args:
        model: decodes.
        sequences: each with a name for errors; an EncodedSequence, or what encode gives.
        stabilizers: by name; None decodes the latent as it is.
        controls: whether the ramp and the constant are scored as well.

    Returns:
        Means over the sequences by name, the controls first.

    Raises:
        ValueError: no frame of a sequence can be scored.
    """
    images = dict.fromkeys(CONTROLS) if controls else {}
    found: dict[str, list[VariantScore]] = {name: [] for name in (*images, *stabilizers)}
    for sequence, encoded in sequences:
        scorers = VariantScorers(
            tuple(stabilizers),
            scored_quantity(model.quantity),
            controls={name: name for name in images},
        )
        for predictions, truth in decode(model, encoded, stabilizers):
            scorers.push(predictions, truth)
        for name, score in scorers.scores().items():
            if score is None:
                raise ValueError(f"{sequence} has no frame with enough valid depth to score")
            found[name].append(score)
    return {name: mean_scores(scores) for name, scores in found.items()}


def score_variants(
    model: GeometryModel, sequences: Sequence[FrameSource], num_tokens: int | None = None
) -> dict[str, VariantScore]:
    """Score every one of VARIANTS ("dyfn" only for a model that has a stabilizer).

    Args:
        model: with a stabilizer of its own or without.
        sequences: each call of one yields its frames, as encode takes them.
        num_tokens: None for the model's default.

    Returns:
        Means over the sequences by variant.

    Raises:
        ValueError: no frame of a sequence can be scored.
    """
    stabilizers = _with_controls(model)
    if model.stabilizer is not None:
        stabilizers["dyfn"] = model.stabilizer
    encoded = (("a sequence", encode(model, frames(), num_tokens)) for frames in sequences)
    return score_encoded(model, encoded, stabilizers, controls=True)


def score_stabilizer(
    model: GeometryModel, sequences: Iterable[EncodedSequence], stabilizer: DyFN | None
) -> VariantScore:
    """Means over the sequences with one stabilizer."""
    return score_encoded(model, ((s.name, s) for s in sequences), {"dyfn": stabilizer})["dyfn"]


def score_controls(
    model: GeometryModel, sequences: Iterable[EncodedSequence]
) -> dict[str, VariantScore]:
    """BASE_ROWS: what a DyFN has to beat, means over the sequences."""
    named = ((s.name, s) for s in sequences)
    return score_encoded(model, named, _with_controls(model), controls=True)


def _with_controls(model: GeometryModel) -> dict[str, DyFN | None]:
    return {"base": None, **latent_controls(model)}


def errors_by_length(
    model: GeometryModel,
    sequence: EncodedSequence,
    stabilizer: DyFN | None,
    lengths: Sequence[int],
) -> dict[int, float]:
    """Video AbsRel of the first n frames, aligned again for each n that the sequence reaches."""
    scorers, found = VariantScorers(("dyfn",), scored_quantity(model.quantity)), {}
    frames = decode(model, sequence, {"dyfn": stabilizer})
    for count, (predictions, truth) in enumerate(frames, 1):
        scorers.push(predictions, truth)
        if count in lengths:
            video = scorers.first.video()
            if video is not None:
                found[count] = video.metrics["abs_rel"]
    return found


def gap_closed(scores: dict[str, VariantScore], variant: str = "dyfn") -> float:
    """Share of the base's gap between video and image AbsRel that a variant closes."""
    base = scores["base"]
    gap = base.video_abs_rel - base.image_abs_rel
    return (base.video_abs_rel - scores[variant].video_abs_rel) / gap if gap else 0.0


def harmed(results: dict[str, dict[str, VariantScore]], share: float) -> dict[str, float]:
    """Where DyFN makes the video AbsRel worse than the base's, by more than a share of it.

    Returns:
        By data set, the relative change; nothing for a model without DyFN.
    """
    changes = {
        name: scores["dyfn"].video_abs_rel / scores["base"].video_abs_rel - 1
        for name, scores in results.items()
        if "dyfn" in scores
    }
    return {name: change for name, change in changes.items() if change > share}


def variant_table(results: dict[str, dict[str, VariantScore]]) -> str:
    """A Markdown table: a row per variant, AbsRel / delta1 for image and video per data set."""
    head = ["", *(f"{name} {kind}" for name in results for kind in ("image", "video"))]
    head += [f"{name} gap closed" for name in results]
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    names = [name for name in VARIANTS if any(name in scores for scores in results.values())]
    for variant in names:
        cells = [variant]
        for scores in results.values():
            s = scores[variant]
            cells.append(f"{s.image_abs_rel:.3f} / {s.image_delta1:.3f}")
            cells.append(f"{s.video_abs_rel:.3f} / {s.video_delta1:.3f}")
        for scores in results.values():
            learned = variant in (*LATENT_CONTROLS, "dyfn")
            cells.append(f"{100 * gap_closed(scores, variant):.0f}%" if learned else "")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
