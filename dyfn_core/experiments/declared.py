"""The experiments: each a question and a few arms, an arm being changes to one base config."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Arm:
    """One way to train DyFN. overrides: dotted setting -> value, on top of the base config."""

    name: str
    overrides: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Experiment:
    """question: what is asked. paper: what the paper found, for comparison.

    kind: "trained" compares the arms after training; "lengths" scores the first arm's runs over
    growing parts of sequences; "statistics" needs the base alone.
    """

    name: str
    question: str
    paper: str
    arms: tuple[Arm, ...] = ()
    kind: str = "trained"


_TERMS = "method.objective"
ALIGN_FIRST = {f"{_TERMS}.align_first_weight": 1.0, f"{_TERMS}.align_all_weight": 0.0}
ALIGN_ALL = {f"{_TERMS}.align_first_weight": 0.0, f"{_TERMS}.align_all_weight": 1.0}
ALIGN_NOT = {f"{_TERMS}.align_first_weight": 0.0, f"{_TERMS}.align_all_weight": 0.0}
CLIP_LENGTHS = (8, 12, 16, 24)
BASE = Arm("DyFN")

EXPERIMENTS = (
    Experiment(
        "effect",
        "Does DyFN close the gap between the video and the image protocol?",
        "MoGe v1, video AbsRel without and with DyFN: Sintel .216 and .180, ScanNet .117 and .073, "
        "KITTI .076 and .062, Bonn .074 and .044.",
        (BASE,),
    ),
    Experiment(
        "without-align",
        "What is the alignment loss L_align worth?",
        "Video AbsRel with and without: Sintel .180 and .245, ScanNet .073 and .124, "
        "KITTI .062 and .088, Bonn .044 and .088.",
        (Arm("with L_align", ALIGN_FIRST), Arm("without L_align", ALIGN_NOT)),
    ),
    Experiment(
        "without-temporal",
        "What is the temporal loss L_temp worth?",
        "Video AbsRel with and without: Sintel .180 and .183, ScanNet .073 and .069, "
        "KITTI .062 and .063, Bonn .044 and .044.",
        (
            Arm("with L_temp", {f"{_TERMS}.temporal_weight": 0.1}),
            Arm("without L_temp", {f"{_TERMS}.temporal_weight": 0.0}),
        ),
    ),
    Experiment(
        "recurrence",
        "Is the ConvGRU better than a GRU on the pooled latent?",
        "Video AbsRel, ConvGRU and GRU: Sintel .180 and .187, ScanNet .073 and .078, "
        "KITTI .062 and .065, Bonn .044 and .053.",
        (Arm("ConvGRU", {"dyfn.kind": "convgru"}), Arm("GRU", {"dyfn.kind": "gru"})),
    ),
    Experiment(
        "alignment",
        "Is a clip better aligned by its first frame or by all of them?",
        "Video AbsRel, first and all: Sintel .180 and .189, ScanNet .073 and .066, "
        "KITTI .062 and .070, Bonn .044 and .045.",
        (Arm("first frame", ALIGN_FIRST), Arm("all frames", ALIGN_ALL)),
    ),
    Experiment(
        "form",
        "Are statistics better replaced (the paper's form) or corrected (the residual form)?",
        "The paper has the first form only.",
        (
            Arm("paper's form", {"dyfn.form": "paper"}),
            Arm("residual", {"dyfn.form": "residual"}),
        ),
    ),
    Experiment(
        "clip-length",
        "How long must training clips be?",
        "No difference beyond .005 between 8, 12, 16 and 24 frames.",
        tuple(Arm(f"{length} frames", {"method.length": length}) for length in CLIP_LENGTHS),
    ),
    Experiment(
        "long-sequences",
        "Does the error stay low as a sequence grows, the alignment solved anew at each length?",
        "The same curves, over 100 ScanNet scenes of 500 frames.",
        (BASE,),
        "lengths",
    ),
    Experiment(
        "statistics",
        "Do the latent's mean and deviation decide scale and shift, and not the shape?",
        "With a, b in 0.5..2 scale ranges over .52..14.04 and shift over -3.18..12.25, while "
        "AbsRel after alignment hardly moves.",
        (),
        "statistics",
    ),
)


def find_experiments(names: list[str]) -> list[Experiment]:
    """Experiments by name, all of them for no name. Raises ValueError on an unknown name."""
    known = {experiment.name: experiment for experiment in EXPERIMENTS}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"no experiment {', '.join(unknown)}; there are {', '.join(known)}")
    return [known[name] for name in names] if names else list(EXPERIMENTS)
