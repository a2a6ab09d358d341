"""What the sub-commands of dyfn-train do: train a base or DyFN, and score the result."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml

from dyfn_core.cli import adapt, experiments
from dyfn_core.cli.chosen_data import data_spec
from dyfn_core.data.datasets import RENDERED
from dyfn_core.data.pool import resolve
from dyfn_core.data.rendered import list_shards
from dyfn_core.data.sequences import clip_frames, folder_frames
from dyfn_core.evaluation.variants import harmed, score_variants, variant_table
from dyfn_core.models.checkpoints import load_model, save_model
from dyfn_core.scoring.variants import VariantScore
from dyfn_core.training.average import average
from dyfn_core.training.config import (
    BaseRunConfig,
    ConfigError,
    RunConfig,
    read_config,
    read_values,
    settings_of,
)
from dyfn_core.training.dry_run import report, stage_costs
from dyfn_core.training.dyfn_config import DyFNRunConfig, UnrolledMethod
from dyfn_core.training.former_config import (
    METHODS,
    SCALE,
    former_command,
    translated,
)
from dyfn_core.training.loop.processes import Processes
from dyfn_core.training.loop.run_folder import CONFIG_FILE
from dyfn_core.training.loop.trainer import (
    BEST_FILE,
    MODEL_FILE,
    InterruptedRunError,
    Trainer,
    TrainingError,
    check_folder,
)
from dyfn_core.training.scaling_curve import draw_curve, last_doubling, scaling_curve, write_csv
from dyfn_core.training.tasks.base import BaseTask
from dyfn_core.training.tasks.dyfn import DyFNTask
from dyfn_core.training.tasks.dyfn_linearized import LinearizedTask
from dyfn_core.training.tasks.dyfn_unrolled import UnrolledTask
from dyfn_core.training.tasks.task import Task

FINE_TUNING = Path(__file__).parents[1] / "training" / "fine_tuning.yaml"


def execute(options: argparse.Namespace) -> int:
    """Do what the parser of `cli.train` has read; returns the exit status."""
    try:
        if options.command == "evaluate":
            return _tell_scores(_evaluate(options), options.most_harm)
        if options.command == "experiments":
            experiments.run(options)
            return 0
        if options.command == "adapt":
            return adapt.run(options)
        if options.command == "curve":
            _curve(options)
            return 0
        if options.command == "average":
            shares = options.shares or [1.0] * len(options.models)
            save_model(average(options.models, shares), options.out)
            return 0
        if options.dry_run:
            print(_dry_run(options))
            return 0
        trainer = _trainer(options)
        trainer.train(options.max_steps)
        _tell_result(trainer)
    except InterruptedRunError as stop:
        print(f"dyfn-train: {stop}", file=sys.stderr)
        return 128 + stop.number
    except (ConfigError, TrainingError, OSError, ValueError) as error:
        print(f"dyfn-train: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("dyfn-train: interrupted; the last checkpoint can be resumed", file=sys.stderr)
        return 130
    return 0


def _trainer(options: argparse.Namespace) -> Trainer:
    overrides = [*options.set, *_data_override(options.data)]
    config: RunConfig
    if options.command == "base":
        if options.config is None:
            raise ConfigError("base: give a config; there is no default one")
        config = base = read_config(options.config, BaseRunConfig, overrides)
        make: Callable[..., Task] = partial(BaseTask, base)
    else:
        config = dyfn = _dyfn_config(options, overrides)
        make = partial(_dyfn_task, dyfn, options.out)
    check_folder(options.out, options.resume)  # before anything long is begun
    _check_data(config)
    processes = Processes(config)
    task = make(device=processes.device)
    return Trainer(task, config, options.out, options.resume, processes)


def _check_data(config: RunConfig) -> None:
    """Before a folder is made and anything is encoded."""
    for one in config.data:
        if not one.root.exists():
            raise ConfigError(
                f"data: {one.root} does not exist; --data [KIND=]PATH names what to train on, "
                "dyfn-worlds renders some"
            )


def _dry_run(options: argparse.Namespace) -> str:
    """What the run would cost here; neither data nor the folder are touched."""
    if options.command == "base":
        raise ConfigError("--dry-run: only `dyfn` with method unrolled has it")
    config = _dyfn_config(options, [*options.set, *_data_override(options.data)])
    if not isinstance(config.method, UnrolledMethod):
        raise ConfigError(f"--dry-run: method {config.method.kind!r} has none, only 'unrolled'")
    cached = config.method.cache_draws > 0
    update = {"cache_draws": 0, "cache": None, "cache_seed": None}
    config = config.model_copy(update={"method": config.method.model_copy(update=update)})
    task = UnrolledTask(config, options.out, Processes(config).device)
    return report(list(stage_costs(task, config)), cached)


def _dyfn_config(options: argparse.Namespace, overrides: list[str]) -> DyFNRunConfig:
    """The settings of `dyfn`, and of its two former names translated."""
    command = options.command
    if options.config is None and (command == SCALE or not options.data):
        instead = "" if command == SCALE else ", or --data to fine-tune on"
        raise ConfigError(f"{command}: give a config{instead}")
    path = options.config or FINE_TUNING
    values = read_values(path, overrides)
    former = former_command(values)
    if command in METHODS:
        print(
            f"dyfn-train: `{command}` is now `dyfn` with method.kind {METHODS[command]!r}; "
            f"{options.out / CONFIG_FILE} is the config in that form",
            file=sys.stderr,
        )
        values = _translated(values, command, path)
    elif former is not None:
        raise ConfigError(
            f"{path} is a config of `dyfn-train {former}`, which still takes it and writes it in "
            f"the form of `dyfn` to OUT/{CONFIG_FILE}; or see docs/training.md for `method`"
        )
    return settings_of(values, DyFNRunConfig, path)


def _translated(values: dict[str, Any], command: str, path: Path) -> dict[str, Any]:
    method = values.get("method")
    kind = method.get("kind") if isinstance(method, dict) else None
    if kind not in (None, METHODS[command]):
        raise ConfigError(f"{path} has method.kind {kind!r}: give it to `dyfn`")
    return translated(values, command)


def _dyfn_task(config: DyFNRunConfig, out: Path, device: torch.device) -> DyFNTask:
    if isinstance(config.method, UnrolledMethod):
        return UnrolledTask(config, out / "latents", device)
    former = out / "summaries"  # of runs of an earlier version
    return LinearizedTask(config, former if former.exists() else out / "gru_inputs", device)


def _tell_result(trainer: Trainer) -> None:
    if trainer.folder is None:
        return
    print(f"step {trainer.step}: {trainer.out / MODEL_FILE}")
    if (trainer.out / BEST_FILE).exists():
        print(f"best validation score, {trainer.best:.4f}: {trainer.out / BEST_FILE}")
    print("either is a --model for dyfn-replay, dyfn-eval and the node")


def _data_override(given: list[str]) -> list[str]:
    """--data PATH, KIND=PATH and mappings as a setting. Raises ConfigError."""
    if not given:
        return []
    sets: list[dict[str, Any]] = []
    for text in given:
        if text.startswith("{"):
            sets.append(_described_data(text))
            continue
        kind, found, root = text.partition("=")
        named = found and not Path(text).exists()
        sets.append({"kind": kind, "root": root} if named else {"root": text})
    return [f"data={json.dumps(sets)}"]


def _described_data(text: str) -> dict[str, Any]:
    try:
        described = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"--data {text!r} is no YAML: {error}") from error
    if not isinstance(described, dict):
        raise ConfigError(f"--data {text!r}: expected a mapping such as {{root: PATH, kind: KIND}}")
    return described


def _curve(options: argparse.Namespace) -> None:
    rows = scaling_curve(options.run, options.metric, options.config)
    out = options.out or options.run
    out.mkdir(parents=True, exist_ok=True)
    write_csv(rows, out / "scaling_curve.csv")
    draw_curve(rows, out / "scaling_curve.png", options.run.resolve().name)
    for metric in [name for name in rows[-1] if name not in ("step", "images")]:
        doubled = last_doubling(rows, metric)
        told = "" if doubled is None else f", {doubled[0]:.4f} at half the images"
        print(f"{metric}: {rows[-1][metric]:.4f} after {rows[-1]['images']:.0f} images{told}")


def _tell_scores(results: dict[str, dict[str, VariantScore]], most_harm: float | None) -> int:
    """The table; with --most-harm also where DyFN does more harm, and then exit status 1."""
    print(variant_table(results))
    worse = {} if most_harm is None else harmed(results, most_harm / 100)
    for name, change in worse.items():
        print(
            f"dyfn-train: {name}: DyFN's video AbsRel is {100 * change:.1f}% above the base's, "
            f"more than --most-harm {most_harm:g}%",
            file=sys.stderr,
        )
    return 1 if worse else 0


def _evaluate(options: argparse.Namespace) -> dict[str, dict[str, VariantScore]]:
    if not options.data:
        raise ValueError("nothing to evaluate on: give --data with a rendered or an RGB-D folder")
    model = load_model(options.model)
    results = {}
    for text in options.data:
        spec = data_spec(text)
        kind = resolve(spec)
        if kind == RENDERED:
            shards = list_shards(spec.root, "clip", "held_out")[: options.clips]
            if not shards:
                raise FileNotFoundError(f"no held-out clip under {spec.root}")
            clips = [partial(clip_frames, shard, options.stride) for shard in shards]
            name = "held-out clips"
            results[f"{name} of {spec.root}" if name in results else name] = score_variants(
                model, clips
            )
        elif kind == "rgbd_folder":
            frames = partial(folder_frames, spec.root, options.stride)
            results[spec.root.name] = score_variants(model, [frames])
        else:
            raise ValueError(
                f"--data {text}: expected a rendered folder or an RGB-D folder, found {kind}"
            )
    return results
