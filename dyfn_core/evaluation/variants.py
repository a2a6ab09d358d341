"""What a learned stabilizer has to beat: base, moving average, frozen statistics, ramp, constant.

A gap between the image and the video protocol proves nothing alone, so these stand beside every
result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from dyfn_core.models.base import GeometryModel
from dyfn_core.models.controls import latent_controls, stabilized_by
from dyfn_core.models.dyfn import DyFN
from dyfn_core.prediction import StreamState
from dyfn_core.scoring.protocols import CONTROLS, SequenceScorer, to_shape

VARIANTS = ("ramp", "constant", "base", "ema", "frozen", "dyfn")


@dataclass(frozen=True)
class VariantScore:
    """AbsRel and delta1 under the image and video protocols, means over sequences."""

    image_abs_rel: float
    image_delta1: float
    video_abs_rel: float
    video_delta1: float


FrameSource = Callable[[], Iterable[tuple[np.ndarray, np.ndarray]]]


@torch.inference_mode()
def score_variants(
    model: GeometryModel, sequences: Sequence[FrameSource], num_tokens: int | None = None
) -> dict[str, VariantScore]:
    """Every one of VARIANTS on every sequence ("dyfn" only for a model that has a stabilizer).

    sequences: each call of one yields its frames, image H x W x 3 uint8 RGB and true depth h x w
    metres (not finite or <= 0: unknown). The model's affine z is scored as it comes from the
    decoder, without recovering focal or shift. Raises ValueError when no frame can be scored.
    """
    found: dict[str, list[VariantScore]] = {}
    for sequence in sequences:
        for name, score in _score_sequence(model, sequence, num_tokens).items():
            found.setdefault(name, []).append(score)
    fields = VariantScore.__dataclass_fields__
    return {
        name: VariantScore(*(float(np.mean([getattr(s, f) for s in scores])) for f in fields))
        for name, scores in found.items()
    }


def _score_sequence(
    model: GeometryModel, sequence: FrameSource, num_tokens: int | None
) -> dict[str, VariantScore]:
    stabilizers: dict[str, DyFN | None] = {
        "base": None,
        **latent_controls(model),
    }
    if model.stabilizer is not None:
        stabilizers["dyfn"] = model.stabilizer
    scorers = {name: SequenceScorer() for name in CONTROLS}
    scorers |= {name: SequenceScorer(quantity=model.quantity) for name in stabilizers}
    states: dict[str, StreamState | None] = dict.fromkeys(stabilizers)
    for image, truth in sequence():
        pixels = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None]
        latent = model.encode(pixels.to(model.device).float() / 255, num_tokens)
        for name, stabilizer in stabilizers.items():
            with stabilized_by(model, stabilizer):
                changed, states[name] = model.stabilize_latent(latent, states[name])
            values = model.decode(changed).values[0].cpu().numpy()
            scorers[name].push(to_shape(values, truth.shape), truth)
        for name, control in CONTROLS.items():
            scorers[name].push(control((truth.shape[0], truth.shape[1])), truth)
    return {name: _variant_score(scorer) for name, scorer in scorers.items()}


def _variant_score(scorer: SequenceScorer) -> VariantScore:
    image, video = scorer.image(), scorer.video()
    if image is None or video is None:
        raise ValueError("a sequence has no frame with enough valid depth to score")
    return VariantScore(
        image.metrics["abs_rel"],
        image.metrics["delta1"],
        video.metrics["abs_rel"],
        video.metrics["delta1"],
    )


def gap_closed(scores: dict[str, VariantScore], variant: str = "dyfn") -> float:
    """Share of the base's gap between video and image AbsRel that a variant closes."""
    base = scores["base"]
    gap = base.video_abs_rel - base.image_abs_rel
    return (base.video_abs_rel - scores[variant].video_abs_rel) / gap if gap else 0.0


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
            learned = variant in ("ema", "frozen", "dyfn")
            cells.append(f"{100 * gap_closed(scores, variant):.0f}%" if learned else "")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
