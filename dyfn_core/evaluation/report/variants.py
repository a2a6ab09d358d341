"""Ways to run the same frames, compared: the report's sentence, its key figures, its curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from dyfn_core.evaluation.report.curves import Curves
from dyfn_core.evaluation.report.html import KeyFigure, KeyFigures, Part

Role = Literal["result", "base", "control"]
SAME = 0.02  # relative difference up to which two numbers are called equal
SECONDS, FRAMES = "seconds from the start", "frame"
DRIFT, VIDEO, DELTA1 = "drift of the scale", "AbsRel of the sequence", "delta1 of the sequence"
METRIC = "AbsRel in metres, not aligned"
LOWER, HIGHER = "lower is better", "higher is better"


@dataclass(frozen=True)
class Variant:
    """One way to run the frames of a sequence.

    Attributes:
        name: As tables and curves call it.
        role: "result": what the report is about, the first of them most; "base": what results are
            compared with, at most one; "control": knows nothing or little, drawn grey.
        scores: As SequenceEvaluation.results(); protocols, drift and latency_ms may be missing.
        columns: Column of SequenceEvaluation -> a value per frame, NaN where there is none.
    """

    name: str
    role: Role
    scores: Mapping[str, Any]
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def drift(self) -> float | None:
        """Standard deviation of the log of true over aligned depth; None under two frames."""
        return _number(self.scores, "drift", "log_std")

    @property
    def abs_rel(self) -> float | None:
        """AbsRel under the video protocol."""
        return _number(self.scores, "video", "abs_rel")

    @property
    def metric_abs_rel(self) -> float | None:
        """AbsRel without alignment, of the frames in metres."""
        return _number(self.scores, "metric", "abs_rel")


def _number(scores: Mapping[str, Any], *keys: str) -> float | None:
    found: Any = scores
    for key in keys:
        found = (found or {}).get(key)
    return None if found is None else float(found)


def headline(variants: Sequence[Variant]) -> str:
    """What the numbers say: a sentence for the first result, and one for each further result.

    Args:
        variants: In the order of the report.

    Returns:
        "NAME lowers the drift of the scale by 22 % ...", "NAME makes no difference ..."; without
        a base or without truth it says what is missing.
    """
    base = next((v for v in variants if v.role == "base"), None)
    results = [v for v in variants if v.role == "result"]
    return " ".join(_sentence(v, base) + _in_metres(v) for v in results)


def _sentence(result: Variant, base: Variant | None) -> str:
    frames = result.scores.get("scored_frames") or result.scores.get("frames")
    over = f" over {frames} frames" if frames else ""
    if result.drift is None or result.abs_rel is None:
        why = "too few frames have" if result.abs_rel is not None else "no frame has"
        return f"{result.name} ran{over}; {why} ground truth to compare the scale with."
    if base is None or base.drift is None or base.abs_rel is None:
        return (
            f"The scale of {result.name} wanders by {result.drift:.1%}{over} (standard deviation), "
            f"and its AbsRel is {result.abs_rel:.3f}; no base was run beside it."
        )
    if result.scores.get("output_sha256", 0) == base.scores.get("output_sha256", 1):
        return f"{result.name} and {base.name} gave the same depth, byte for byte{over}."
    drift, error = (base.drift, result.drift), (base.abs_rel, result.abs_rel)
    if _equal(*drift) and _equal(*error):
        return (
            f"{result.name} makes no difference to {base.name}{over}: drift of the scale "
            f"{_both(*drift)}, AbsRel of the sequence {_both(*error)}."
        )
    joint = "and" if (drift[1] < drift[0]) == (error[1] < error[0]) else "but"
    if _equal(*drift) or _equal(*error):
        joint = "and"
    return (
        f"{result.name} {_verb('the drift of the scale', *drift)} {joint} "
        f"{_verb('the error of the sequence', *error)} against {base.name}{over} "
        f"(drift {_both(*drift)}, AbsRel {_both(*error)})."
    )


def _in_metres(result: Variant) -> str:
    error = result.metric_abs_rel
    if error is None:
        return ""
    return f" {result.name} is in metres: AbsRel {error:.3f} without any alignment."


def _verb(what: str, base: float, value: float) -> str:
    if _equal(base, value):
        return f"leaves {what} as it is"
    word = "lowers" if value < base else "raises"
    return f"{word} {what} by {_percent(base, value)}"


def _both(base: float, value: float) -> str:
    return f"{base:.3f} to {value:.3f}"


def _percent(base: float, value: float) -> str:
    if base == 0:
        return f"{value:.2g}"
    change = abs(value / base - 1) * 100
    return f"{change:.0f} %" if change < 200 else f"{value / base:.1f} times"


def _equal(base: float, value: float) -> bool:
    return abs(value - base) <= SAME * max(abs(base), abs(value))


def key_figures(variants: Sequence[Variant]) -> KeyFigures:
    """The first result's numbers, with those of base and further results beside each.

    Args:
        variants: In the order of the report; controls are left out.

    Returns:
        Drift, errors and times that are known; the number of frames.
    """
    shown = [v for v in variants if v.role != "control"]
    rows = (
        (DRIFT, LOWER, 3, [v.drift for v in shown]),
        (VIDEO, LOWER, 3, [v.abs_rel for v in shown]),
        (DELTA1, HIGHER, 3, [_number(v.scores, "video", "delta1") for v in shown]),
        (METRIC, LOWER, 3, [v.metric_abs_rel for v in shown]),
        ("ms a frame (median)", LOWER, 1, [_number(v.scores, "latency_ms", "p50") for v in shown]),
    )
    figures = [_figure(shown, *row) for row in rows if any(value is not None for value in row[-1])]
    frames = shown[0].scores.get("frames")
    if frames:
        figures.append(KeyFigure("frames", str(frames)))
    return KeyFigures(figures)


def _figure(
    shown: Sequence[Variant], name: str, wanted: str, digits: int, values: Sequence[float | None]
) -> KeyFigure:
    texts = ["–" if value is None else f"{value:.{digits}f}" for value in values]
    beside = {v.name: text for v, text in zip(shown[1:], texts[1:], strict=True)}
    bases = (value for v, value in zip(shown, values, strict=True) if v.role == "base")
    base, first = next(bases, None), values[0]
    if base is None or first is None or base <= 0:
        return KeyFigure(name, texts[0], wanted, beside)
    if _equal(base, first):
        return KeyFigure(name, texts[0], wanted, beside, "no difference")
    change = f"{_percent(base, first)} {'lower' if first < base else 'higher'}"
    better = (first < base) == (wanted == LOWER)
    return KeyFigure(name, texts[0], wanted, beside, change, better)


def over_time(variants: Sequence[Variant], stamps: np.ndarray | None = None) -> list[Part]:
    """What wanders over a sequence.

    Args:
        variants: Whose columns are drawn; those of controls in grey.
        stamps: Seconds of each frame; None, or stamps that fall: frames are counted.

    Returns:
        True over predicted depth, errors and shift; nothing where no frame has truth.
    """
    x, label = seconds_axis(stamps)
    muted = {v.name for v in variants if v.role == "control"}
    inverse = any(v.scores.get("quantity") == "disparity" for v in variants)

    def curves(title: str, unit: str, column: str) -> list[Part]:
        known = {v.name: v.columns[column] for v in variants if column in v.columns}
        lines = {name: values for name, values in known.items() if np.isfinite(values).any()}
        return [Curves(title, lines, label, unit, x, muted)] if lines else []

    return [
        *curves(
            "True over predicted depth, one alignment for the sequence (1: no drift)",
            "times",
            "video_ratio",
        ),
        *curves(
            "Error, one alignment for the sequence (video)",
            "AbsRel (share of the true depth)",
            "video_abs_rel",
        ),
        *curves(
            "Error, each frame aligned by itself (image)",
            "AbsRel (share of the true depth)",
            "image_abs_rel",
        ),
        *curves(
            "Error in metres, no alignment", "AbsRel (share of the true depth)", "metric_abs_rel"
        ),
        *curves("Shift that fits each frame best", "1 / m" if inverse else "m", "shift"),
    ]


def seconds_axis(stamps: np.ndarray | None) -> tuple[np.ndarray | None, str]:
    """Seconds from the first frame and the axis' label; None and "frame" when stamps fall."""
    if stamps is None or not len(stamps) or (np.diff(stamps) < 0).any():
        return None, FRAMES
    return stamps - stamps[0], SECONDS
