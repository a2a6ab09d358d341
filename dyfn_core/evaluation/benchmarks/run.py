"""A method on the sequences of a benchmark: all protocols, all measures, the controls beside it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from dyfn_core.data.frames import DataError, FrameError
from dyfn_core.evaluation.benchmarks.pictures import BenchmarkPictures, SequencePictures
from dyfn_core.evaluation.benchmarks.predictions import Method, Predict
from dyfn_core.evaluation.benchmarks.registry import BenchmarkFrame, BenchmarkSequence, Opened
from dyfn_core.evaluation.temporal import TRUTH, TemporalScorer
from dyfn_core.scoring.fits import L1
from dyfn_core.scoring.plausibility import Plausibility
from dyfn_core.scoring.protocols import (
    CONTROLS,
    SequenceScore,
    SequenceScorer,
    drift,
    spread,
    video_column,
)
from dyfn_core.scoring.variants import VariantScorers

PROTOCOLS = ("image", "video", "metric")
PACKAGES = ("dyfn_ros", "numpy", "torch", "opencv-python-headless")
Note = Callable[[str], None]


@dataclass(frozen=True)
class Scoring:
    """How frames are scored; see SequenceScorer. temporal: also measure TAE and flicker."""

    fit: str = L1
    samples_per_frame: int = 20_000
    max_samples: int = 4_000_000
    temporal: bool = True

    def scorer(self, depth_max: float, quantity: str) -> SequenceScorer:
        """An empty scorer of these options."""
        return SequenceScorer(
            depth_max, self.samples_per_frame, self.max_samples, quantity, self.fit
        )


def variant_scorers(method: Method, depth_max: float, scoring: Scoring) -> VariantScorers:
    """Empty scorers of a method's variants, and of the controls beside them."""
    scorer = partial(scoring.scorer, depth_max)
    controls = {name: f"control: {name}" for name in CONTROLS}
    return VariantScorers(method.variants, method.quantity, scorer, controls)


def score_sequence(
    sequence: BenchmarkSequence,
    method: Method,
    depth_max: float,
    scoring: Scoring,
    pictures: BenchmarkPictures | None = None,
) -> dict[str, Any]:
    """Everything about one sequence, as plain values. pictures: takes some of its frames.

    Raises FrameError or DataError, naming the file or sequence and what was expected.
    """
    scorers = variant_scorers(method, depth_max, scoring)
    taken = None if pictures is None else pictures.begin(sequence)
    plausibility = Plausibility(len(sequence.numbers))
    with TemporalScorer() as temporal:
        steady = temporal if scoring.temporal else None
        frames_seen = observed(sequence, plausibility)
        predict = method.open(sequence)
        frames = _push_all(sequence.name, frames_seen, predict, scorers, depth_max, steady, taken)
        variants = {name: _summary(scorer) for name, scorer in scorers.scorers.items()}
        steadiness: dict[str, Any] = {}
        if scoring.temporal:
            steadiness = temporal.results(
                {
                    name: (found["alignment"]["scale"], found["alignment"]["shift"], s.quantity)
                    for (name, found), s in zip(
                        variants.items(), scorers.scorers.values(), strict=True
                    )
                    if found["alignment"] is not None
                }
            )
    if pictures is not None and taken is not None:
        videos = {name: scorers.scorers[name].video() for name in scorers.variants}
        pictures.finish(taken, videos)
    for name, found in variants.items():
        found["temporal"] = steadiness.get(name)
    scored = next(iter(variants.values()))["scored_frames"]
    return {
        "name": sequence.name,
        "frames": frames,
        "available_frames": sequence.available,
        "first": sequence.numbers[0],
        "last": sequence.numbers[-1],
        "temporal_truth": steadiness.get(TRUTH),
        "variants": variants,
        "over_time": {name: _over_time(scorer) for name, scorer in scorers.scorers.items()},
        "warnings": plausibility.warnings(scored),
    }


def observed(sequence: BenchmarkSequence, plausibility: Plausibility) -> Iterator[BenchmarkFrame]:
    """The frames of a sequence, which plausibility takes too, but for those of context."""
    for frame in sequence.frames():
        if not frame.context:
            plausibility.push(frame.image, frame.truth, camera_matrix=frame.camera_matrix)
        yield frame


def _push_all(
    name: str,
    frames: Iterator[BenchmarkFrame],
    predict: Predict,
    scorers: VariantScorers,
    depth_max: float,
    temporal: TemporalScorer | None,
    taken: SequencePictures | None,
) -> int:
    count = 0
    for count, frame in enumerate(frames, start=1):
        found = predict(count - 1, frame)
        try:
            maps = scorers.push(found, frame.truth)
        except ValueError as error:
            raise FrameError(f"{name}, frame {count - 1}: {error}") from error
        truth = np.where(frame.truth <= depth_max, frame.truth, np.float32(np.nan))
        if temporal is not None:
            temporal.push(frame.image, truth, maps, frame.camera_matrix, frame.pose)
        if taken is not None:
            taken.add(count - 1, frame.image, maps, truth, scorers.first.frames[-1])
    return count


def _summary(scorer: SequenceScorer) -> dict[str, Any]:
    scores = {"image": scorer.image(), "video": scorer.video(), "metric": scorer.metric()}
    video = scores["video"]
    scored = [frame.coverage for frame in scorer.frames if frame.metrics is not None]
    return {
        **{name: _metrics(score) for name, score in scores.items()},
        "alignment": None if video is None else {"scale": video.scale, "shift": video.shift},
        "coverage": float(np.mean(scored)) if scored else None,
        "scored_frames": len(scored),
        "drift": drift(video),
        "spread": spread(scorer.frames),
    }


def _over_time(scorer: SequenceScorer) -> dict[str, list[float | None]]:
    """scale and shift of each frame, its AbsRel and ratio under the video protocol."""
    columns = {name: scorer.frames.column(name) for name in ("scale", "shift")}
    video, frames = scorer.video(), len(scorer.frames)
    for name in ("abs_rel", "ratio"):
        columns[f"video_{name}"] = video_column(video, name, frames)
    return {
        name: [None if np.isnan(value) else float(value) for value in values]
        for name, values in columns.items()
    }


def _metrics(score: SequenceScore | None) -> dict[str, float] | None:
    return None if score is None else score.metrics


def evaluate(
    opened: Opened,
    method: Method,
    scoring: Scoring | None = None,
    *,
    allow_missing: bool = False,
    note: Note = lambda line: None,
    pictures: BenchmarkPictures | None = None,
) -> dict[str, Any]:
    """All sequences and their means, as plain values: what results.json holds.

    allow_missing: a sequence that cannot be scored is listed under `missing` and the others go on;
    otherwise its error ends it. note: is told a line a sequence. pictures: takes some frames.
    Raises DataError when no sequence could be scored.
    """
    scoring = scoring or Scoring()
    done, missing = [], list(opened.missing)
    for sequence in opened.sequences:
        try:
            found = score_sequence(sequence, method, opened.settings.depth_max, scoring, pictures)
        except (FrameError, DataError) as error:
            if not allow_missing:
                raise
            missing.append(f"{sequence.name}: {error}")
            note(f"{sequence.name}: not scored: {error}")
            continue
        done.append(found)
        note(_line(found))
        for text in found["warnings"]:
            note(f"{sequence.name}: implausible: {text}")
    if not done:
        raise DataError(f"no sequence could be scored: {'; '.join(missing)}")
    return {
        "benchmark": opened.benchmark.name,
        "layout": opened.layout,
        "settings": plain_settings(opened),
        "scoring": asdict(scoring),
        "quantity": method.quantity,
        "in_metres": list(method.in_metres),
        "versions": versions(),
        "missing": missing,
        "problems": opened.report.problems,
        "warnings": [f"{found['name']}: {text}" for found in done for text in found["warnings"]],
        "frames": sum(found["frames"] for found in done),
        "variants": mean_of([found["variants"] for found in done]),
        "temporal_truth": mean_of([found["temporal_truth"] for found in done]),
        "sequences": done,
    }


def plain_settings(opened: Opened) -> dict[str, Any]:
    """The settings as JSON can hold them: no cap is None."""
    settings = asdict(opened.settings)
    settings["crop"] = list(opened.settings.crop)
    if not np.isfinite(settings["depth_max"]):
        settings["depth_max"] = None
    return settings


def versions() -> dict[str, str]:
    """Python's and those of the packages that numbers depend on."""
    found = {"python": ".".join(map(str, sys.version_info[:3]))}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def mean_of(trees: list[Any]) -> Any:
    """The mean over sequences of equal trees of numbers; a number that one lacks is left out of
    its mean, and is None where all lack it. Counts (integers) are summed."""
    known = [tree for tree in trees if tree is not None]
    if not known:
        return None
    if isinstance(known[0], dict):
        names = dict.fromkeys(name for tree in known for name in tree)
        return {name: mean_of([tree.get(name) for tree in known]) for name in names}
    if all(isinstance(value, int) for value in known):
        return sum(known)
    return float(np.mean(known))


def _line(found: dict[str, Any]) -> str:
    name, first = next(iter(found["variants"].items()))
    scores = []
    for protocol in ("image", "video"):
        metrics = first[protocol]
        scores.append(
            f"{protocol} not scored"
            if metrics is None
            else f"{protocol} {metrics['abs_rel']:.3f} / {metrics['delta1']:.3f}"
        )
    return f"{found['name']}: {found['frames']} frames, {name}: {', '.join(scores)}"
