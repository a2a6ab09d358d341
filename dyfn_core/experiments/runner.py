"""Trains the arms of experiments, each once, and scores them with their controls."""

from __future__ import annotations

import copy
import hashlib
import json
import logging
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from dyfn_core.data.clips import find_sequences
from dyfn_core.data.sequences import clip_frames, folder_frames
from dyfn_core.evaluation.variants import (
    EncodedSequence,
    encode_sequence,
    score_controls,
    score_stabilizer,
)
from dyfn_core.experiments.declared import Arm
from dyfn_core.files import write_text
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import load_model
from dyfn_core.models.dyfn import DyFNConfig
from dyfn_core.scoring.variants import VariantScore
from dyfn_core.training.config import ConfigError, override, read_values, settings_of
from dyfn_core.training.dyfn_config import DyFNRunConfig, UnrolledMethod
from dyfn_core.training.former_config import STABILIZER, former_command, translated
from dyfn_core.training.loop.checkpoint import has_state
from dyfn_core.training.loop.processes import Processes
from dyfn_core.training.loop.run_folder import CONFIG_FILE, RESULTS_FILE
from dyfn_core.training.loop.trainer import MODEL_FILE, Trainer, TrainingError
from dyfn_core.training.tasks.base import clip_source
from dyfn_core.training.tasks.dyfn_unrolled import UnrolledTask

HELD_OUT = "held-out clips"
CACHE_SEED = 0  # one cache serves the runs of all seeds
# What the runs of one arm may differ in.
BOOKKEEPING: Any = {"seed": True, "method": {"cache": True, "cache_seed": True}}

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plan:
    """What experiments have in common.

    config: YAML file of a DyFNRunConfig, method unrolled; overrides: KEY=VALUE on top of it. out:
    folder of all runs. seeds: how often each arm is trained. recordings: folders to score on
    besides the held-out clips of the config's data, of which `clips` are taken; stride: every N-th
    frame of either.
    """

    config: Path
    overrides: tuple[str, ...]
    out: Path
    seeds: int
    recordings: tuple[Path, ...] = ()
    clips: int = 12
    stride: int = 4


@dataclass
class ArmScores:
    """data set -> score of each seed's run; failed: seed -> why it has none."""

    scores: dict[str, list[VariantScore]] = field(default_factory=dict)
    failed: dict[int, str] = field(default_factory=dict)


class Runner:
    """Runs and scores arms under one plan; what is finished on disk is not done again.

    Raises ConfigError when the plan's config cannot be used, FileNotFoundError when there is
    nothing to score on.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._values = read_values(plan.config, plan.overrides)
        if former_command(self._values) == STABILIZER:
            self._values = translated(self._values, STABILIZER)
        self.config = self._settings(Arm(""), 0)
        self.model = load_model(self.config.base)
        self.model.stabilizer = None
        self._scenes: dict[str, list[EncodedSequence]] = {}

    def scenes(self) -> dict[str, list[EncodedSequence]]:
        """Data set -> its encoded sequences."""
        if not self._scenes:
            self._scenes = encode_all(self.model, self.config, self.plan, self.plan.stride)
        return self._scenes

    def controls(self) -> dict[str, dict[str, VariantScore]]:
        """Data set -> control -> score."""
        path = self.plan.out / f"controls_{self._measure()}.json"
        if not path.exists():
            found = {name: score_controls(self.model, s) for name, s in self.scenes().items()}
            plain = {n: {k: asdict(v) for k, v in row.items()} for n, row in found.items()}
            _write_json(path, plain)
        return {
            name: {control: VariantScore(**score) for control, score in row.items()}
            for name, row in json.loads(path.read_text()).items()
        }

    def arm(self, arm: Arm) -> ArmScores:
        """Train and score an arm with every seed. A run that fails is reported, not raised."""
        found = ArmScores()
        for seed in range(self.plan.seeds):
            try:
                folder = self.train(arm, seed)
            except TrainingError as error:
                logger.warning("%s, seed %d: %s", arm.name, seed, error)
                found.failed[seed] = str(error)
                continue
            for name, score in self._scores(folder).items():
                found.scores.setdefault(name, []).append(score)
        return found

    def train(self, arm: Arm, seed: int) -> Path:
        """The folder of a finished run of an arm; it goes on where it stopped, if it did."""
        config = self._settings(arm, seed)
        folder = self._folder(_digest(config), seed)
        if (folder / RESULTS_FILE).exists():
            logger.info("%s, seed %d: finished before", arm.name, seed)
            return folder
        logger.info("%s, seed %d", arm.name, seed)
        processes = Processes(config)
        task = UnrolledTask(config, self.plan.out / "latents", processes.device)
        Trainer(task, config, folder, has_state(folder), processes).train()
        return folder

    def _scores(self, folder: Path) -> dict[str, VariantScore]:
        path = folder / f"scores_{self._measure()}.json"
        if not path.exists():
            stabilizer = load_model(folder / MODEL_FILE, self.model.device).stabilizer
            found = {
                name: asdict(score_stabilizer(self.model, scenes, stabilizer))
                for name, scenes in self.scenes().items()
            }
            _write_json(path, found)
        return {name: VariantScore(**s) for name, s in json.loads(path.read_text()).items()}

    def _folder(self, digest: str, seed: int) -> Path:
        """Of a run; one of an earlier version with the same settings counts as that run."""
        folder = self.plan.out / "runs" / digest / f"seed_{seed}"
        return folder if folder.exists() else self._former_runs.get((digest, seed), folder)

    @cached_property
    def _former_runs(self) -> dict[tuple[str, int], Path]:
        """Digest and seed -> folder of the runs whose config is of `dyfn-train stabilizer`."""
        found = {}
        for path in self.plan.out.glob(f"runs/*/seed_*/{CONFIG_FILE}"):
            values = yaml.safe_load(path.read_text())
            if former_command(values) == STABILIZER:
                plain = translated(values, STABILIZER, tell=False)
                config = settings_of(plain, DyFNRunConfig, path)
                found[_digest(config), config.seed] = path.parent
        return found

    def _settings(self, arm: Arm, seed: int) -> DyFNRunConfig:
        values = copy.deepcopy(self._values)
        for key, value in {**arm.overrides, "seed": seed}.items():
            override(values, f"{key}={json.dumps(value)}")
        config = settings_of(values, DyFNRunConfig, self.plan.config)
        if not isinstance(config.method, UnrolledMethod):
            raise ConfigError(f"{self.plan.config}: experiments need method.kind 'unrolled'")
        if not config.method.cache_draws:
            return config
        shared = {"cache": self.plan.out / "latents", "cache_seed": CACHE_SEED}
        return config.model_copy(update={"method": config.method.model_copy(update=shared)})

    def _measure(self) -> str:
        """Short name of what is scored on, and with which base."""
        plan = self.plan
        places = [str(path.resolve()) for path in plan.recordings]
        data = self.config.model_dump(mode="json")["data"]
        told = [str(self.config.base), data, places, plan.clips, plan.stride]
        return hashlib.sha256(json.dumps(told).encode()).hexdigest()[:8]


def encode_all(
    model: GeometryModel, config: DyFNRunConfig, plan: Plan, stride: int
) -> dict[str, list[EncodedSequence]]:
    """The plan's recordings, and held-out clips of the config's data, by data set.

    Raises FileNotFoundError when there is neither.
    """
    found: dict[str, list[EncodedSequence]] = {}
    source = clip_source(config, 2, (1, 1))
    try:
        sequences = find_sequences(source, "held_out").sequences[: plan.clips]
    except FileNotFoundError as error:
        if not plan.recordings:
            raise
        logger.warning("scoring on recordings only: %s", error)
        sequences = []
    if sequences:
        found[HELD_OUT] = [
            encode_sequence(model, sequence.name, clip_frames(sequence, stride))
            for sequence in sequences
        ]
    for folder in plan.recordings:
        found[folder.name] = [encode_sequence(model, folder.name, folder_frames(folder, stride))]
    return found


def _digest(config: DyFNRunConfig) -> str:
    """Short name of an arm's settings; arms of different experiments that agree share runs."""
    plain: dict[str, Any] = config.model_dump(mode="json", exclude=BOOKKEEPING)
    plain["dyfn"] = DyFNConfig(**config.dyfn).to_dict()
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:8]


def _write_json(path: Path, values: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(values, indent=1) + "\n")
