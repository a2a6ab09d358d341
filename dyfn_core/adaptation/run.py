"""The whole of `dyfn-train adapt`: recordings in, a model out if it has become better."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from dyfn_core.adaptation.config import AdaptConfig
from dyfn_core.adaptation.parts import Parts, parts_of
from dyfn_core.adaptation.recording import (
    SparseFrames,
    load_frames,
    reduce_recording,
    save_frames,
)
from dyfn_core.adaptation.scores import HeldBackScore, score_frames
from dyfn_core.adaptation.task import AdaptTask
from dyfn_core.data.datasets import AUTO, open_posed
from dyfn_core.files import write_text
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import load_model, save_model
from dyfn_core.training.config import ConfigError
from dyfn_core.training.loop.processes import Processes
from dyfn_core.training.loop.trainer import BEST_FILE, Trainer, check_folder
from dyfn_core.training.tasks.latent_cache import base_digest

CACHE = "recordings"  # folder of a run
HELD_BACK, TEST = "held back", "test"


class Described(NamedTuple):
    """A recording as it was asked for: where, of which kind, with which options of that kind."""

    root: Path
    kind: str
    options: dict[str, Any]


@dataclass(frozen=True)
class Compared:
    """Both models on one part of one recording.

    Attributes:
        recording: Its name.
        part: HELD_BACK or TEST.
        frames: How many are in it.
        before: The model as it was.
        after: The adapted one.
    """

    recording: str
    part: str
    frames: int
    before: HeldBackScore
    after: HeldBackScore


@dataclass(frozen=True)
class AdaptResult:
    """How it ended.

    Attributes:
        rows: Both models on what was held back and on the test, recording by recording.
        before, after: Error of the held-back points, see AdaptTask; lower is better.
        steps: That were made.
        problems: What of the recordings was not used, with how often.
    """

    rows: list[Compared]
    before: float
    after: float
    steps: int
    problems: dict[str, int]

    @property
    def better(self) -> bool:
        """Whether the adapted model is better, and was written."""
        return self.after < self.before


def adapt(config: AdaptConfig, out: Path, folder: Path, resume: bool) -> AdaptResult | None:
    """Adapt a model to recordings.

    Args:
        config: Settings.
        out: File of the model; it is written only if the model has become better.
        folder: Of the run: checkpoints, log, reduced recordings.
        resume: Go on from the folder's checkpoint.

    Returns:
        None in all processes but the main one.

    Raises:
        ConfigError: A setting cannot be used.
        DataError: A recording cannot be used.
        TrainingError: The folder holds a run already, or none to resume, or the run failed.
        InterruptedRunError: A signal ended the run, after a checkpoint.
    """
    described = [parse_recording(text) for text in config.recordings]
    _check_out(out)
    check_folder(folder, resume)
    processes = Processes(config)
    model = load_model(config.base).to(processes.device).eval()
    if processes.is_main:
        _reduce(config, described, model, folder / CACHE)
    processes.wait()
    recordings = [load_frames(path) for path in sorted((folder / CACHE).glob("*.safetensors"))]
    parts = [parts_of(frames, config.hold_back, config.test) for frames in recordings]
    task = AdaptTask(config, model, recordings, parts)
    tested = [_tested(model, *pair) for pair in zip(recordings, parts, strict=True)]
    trainer = Trainer(task, config, folder, resume, processes)
    trainer.train()
    if not processes.is_main:
        return None
    adapted = load_model(folder / BEST_FILE, str(processes.device))
    rows = _compared(task, tested, adapted)
    problems = sum((Counter(frames.problems) for frames in recordings), Counter[str]())
    result = AdaptResult(rows, task.before, trainer.best, trainer.step, dict(problems))
    if result.better:
        notes = {"adapted_from": config.base, "trained_steps": str(trainer.step)}
        save_model(adapted, out, notes=notes)
    return result


def _tested(model: GeometryModel, frames: SparseFrames, parts: Parts) -> HeldBackScore | None:
    return score_frames(model, frames, parts.test) if parts.test else None


def _compared(
    task: AdaptTask, tested: list[HeldBackScore | None], adapted: GeometryModel
) -> list[Compared]:
    """Both models on every part. tested: the former one on each recording's test."""
    rows = []
    for index, (frames, parts) in enumerate(zip(task.recordings, task.parts, strict=True)):
        after = score_frames(adapted, frames, parts.held_back)
        before = task.bundled[index]
        rows.append(Compared(frames.name, HELD_BACK, len(parts.held_back), before, after))
        earlier = tested[index]
        if earlier is not None:
            later = score_frames(adapted, frames, parts.test)
            rows.append(Compared(frames.name, TEST, len(parts.test), earlier, later))
    return rows


def _check_out(out: Path) -> None:
    """Before anything long is begun."""
    if out.suffix != ".safetensors":
        raise ConfigError(f"--out {out}: expected a file NAME.safetensors")
    if not out.absolute().parent.is_dir():
        raise ConfigError(f"--out {out}: there is no folder {out.absolute().parent}")


def parse_recording(text: str) -> Described:
    """PATH, KIND=PATH, or a mapping such as {root: PATH, kind: KIND, OPTION: VALUE}, in YAML."""
    if not text.startswith("{"):
        kind, found, root = text.partition("=")
        named = bool(found) and not Path(text).exists()
        return Described(Path(root), kind, {}) if named else Described(Path(text), AUTO, {})
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"recording {text!r} is no YAML: {error}") from error
    if not isinstance(values, dict) or not isinstance(values.get("root"), str):
        raise ConfigError(f"recording {text!r}: expected a mapping such as {{root: PATH}}")
    rest = {name: value for name, value in values.items() if name not in ("root", "kind")}
    return Described(Path(values["root"]), values.get("kind", AUTO), rest)


def _reduce(
    config: AdaptConfig, described: list[Described], model: GeometryModel, folder: Path
) -> None:
    """Make the files of the recordings, unless an earlier start of this run has made them."""
    folder.mkdir(parents=True, exist_ok=True)
    made_of = {"model": base_digest(model), "rate": config.rate, "recordings": config.recordings}
    text = json.dumps(made_of, indent=1) + "\n"
    told = folder / "made_of.json"
    if told.exists() and told.read_text() == text:
        return
    opened = [one for each in described for one in open_posed(*each)]
    for index, recording in enumerate(opened):
        path = folder / f"{index:03d}.safetensors"
        save_frames(reduce_recording(recording, model, config.rate), path)
    for extra in folder.glob("*.safetensors"):
        if int(extra.stem) >= len(opened):
            extra.unlink()
    write_text(told, text)
