"""dyfn-train experiments: the paper's claims on a base of one's own, tables into a file."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dyfn_core.cli.experiments_options import LENGTHS
from dyfn_core.evaluation.empirical_study import draw_grid, statistics_grid
from dyfn_core.evaluation.variants import EncodedSequence, errors_by_length
from dyfn_core.experiments.declared import EXPERIMENTS, Experiment, find_experiments
from dyfn_core.experiments.report import (
    grid_table,
    length_table,
    section,
    trained_table,
    verdicts,
    write_section,
)
from dyfn_core.experiments.runner import Plan, Runner, encode_all
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import load_model
from dyfn_core.models.controls import ema_control, frozen_control
from dyfn_core.models.dyfn import DyFN
from dyfn_core.training.loop.trainer import MODEL_FILE

GRID_FRAMES = 24


def run(options: argparse.Namespace) -> None:
    """Run the chosen experiments one by one, printing and writing each when it is done."""
    if options.list:
        for experiment in EXPERIMENTS:
            print(f"{experiment.name:18} {experiment.question}")
        return
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    chosen = find_experiments(options.name)
    base = [f"base={options.base}"] if options.base else []
    plan = Plan(
        config=options.config,
        overrides=(*base, *options.set),
        out=options.out,
        seeds=options.seeds,
        recordings=tuple(options.recording),
        clips=options.clips,
        stride=options.stride,
    )
    runner = Runner(plan)
    for experiment in chosen:
        text = section(
            experiment, _body(experiment, runner, options), _command(experiment, options)
        )
        print(f"\n{text}\n")
        if options.write is not None:
            write_section(options.write, experiment.name, text)


def _body(experiment: Experiment, runner: Runner, options: argparse.Namespace) -> list[str]:
    if experiment.kind == "lengths":
        return _lengths(experiment, runner, options.lengths)
    if experiment.kind == "statistics":
        return _statistics(runner, options.write)
    arms = {arm.name: runner.arm(arm) for arm in experiment.arms}
    controls = runner.controls()
    config = runner.config
    told = f"{config.steps} steps an arm" if config.hours is None else f"{config.hours} h an arm"
    judged = [f"- {sentence}" for sentence in verdicts(controls, arms)]
    spread = "± is the standard deviation over the seeds."
    return [trained_table(controls, arms), "\n".join(judged), f"{told}. {spread}"]


def _lengths(experiment: Experiment, runner: Runner, lengths: Sequence[int]) -> list[str]:
    """Curves over every frame of those sequences that reach the first length."""
    found = encode_all(runner.model, runner.config, runner.plan, stride=1)
    scenes = [s for scenes in found.values() for s in scenes if len(s.depth) >= min(lengths)]
    if not scenes:
        longest = max(len(s.depth) for scenes in found.values() for s in scenes)
        return [f"Not run: no sequence has {min(lengths)} frames, the longest has {longest}."]
    folders = [runner.train(experiment.arms[0], seed) for seed in range(runner.plan.seeds)]
    channels = runner.model.latent_channels
    rows: dict[str, list[DyFN | None]] = {
        "base": [None],
        "ema": [ema_control(channels)],
        "frozen": [frozen_control(channels)],
        "**DyFN**": [load_model(folder / MODEL_FILE).stabilizer for folder in folders],
    }
    curves: dict[str, dict[int, list[float]]] = {}
    for name, stabilizers in rows.items():
        found_curves = [_curve(runner.model, scenes, s, lengths) for s in stabilizers]
        curves[name] = {n: [curve[n] for curve in found_curves] for n in found_curves[0]}
    counts = {n: sum(len(s.depth) >= n for s in scenes) for n in curves["base"]}
    told = ", ".join(f"{count} with {length} frames or more" for length, count in counts.items())
    return [length_table(curves), f"Sequences: {told}."]


def _curve(
    model: GeometryModel,
    sequences: Sequence[EncodedSequence],
    stabilizer: DyFN | None,
    lengths: Sequence[int],
) -> dict[int, float]:
    """Number of frames -> mean over the sequences that long."""
    curves = [errors_by_length(model, s, stabilizer, lengths) for s in sequences]
    reached = sorted({length for curve in curves for length in curve})
    return {n: float(np.mean([c[n] for c in curves if n in c])) for n in reached}


def _statistics(runner: Runner, write: Path | None) -> list[str]:
    """The grid on frames spread over all scenes, with a figure beside the written file."""
    latents = [latent for s in runner.scenes().values() for scene in s for latent in scene.latents]
    places = np.unique(np.linspace(0, len(latents) - 1, GRID_FRAMES).round().astype(int))
    grid = statistics_grid(runner.model, [latents[place] for place in places])
    folder = runner.plan.out if write is None else write.parent
    picture = folder / "figures" / "statistics_grid.png"
    draw_grid(grid, picture)
    figure = f"![scale, shift and error over the grid](figures/{picture.name})"
    return [grid_table(grid), f"{grid.frames} frames.", figure]


def _command(experiment: Experiment, options: argparse.Namespace) -> list[str]:
    """The words to type to get the table again; of an absolute path its name alone."""
    words = ["dyfn-train", "experiments", experiment.name, "--config", _shown(options.config)]
    words += ["--base", _shown(Path(options.base))] if options.base else []
    words += [word for path in options.recording for word in ("--data", _shown(path))]
    words += ["--seeds", str(options.seeds), "--clips", str(options.clips)]
    words += ["--stride", str(options.stride)]
    if experiment.kind == "lengths" and tuple(options.lengths) != LENGTHS:
        words += ["--lengths", *map(str, options.lengths)]
    given = [setting for setting in options.set if "=/" not in setting and "[/" not in setting]
    words += [word for setting in given for word in ("--set", setting)]
    words += ["--write", _shown(options.write)] if options.write else []
    return words


def _shown(path: Path) -> str:
    return path.name if path.is_absolute() else str(path)
