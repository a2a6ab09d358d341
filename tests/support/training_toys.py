"""A tiny task whose loss is a plain mean over a batch, and the means to run it anywhere."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyfn_core.models.checkpoints import save_model
from dyfn_core.models.mini import MiniConfig, MiniModel
from dyfn_core.training.config import RunConfig
from dyfn_core.training.loop.processes import Processes, share_of
from dyfn_core.training.loop.trainer import Trainer
from dyfn_core.training.tasks.task import Task
from tests.support.made_frames import write_shard
from tests.support.pinhole import PinholeModel
from tests.support.seeded import redraw, uniform

BATCH = 4
PATIENCE = 300.0  # seconds for what another process does


@dataclass(frozen=True)
class Latents:
    """B x 3 x h x w."""

    features: Tensor


class ToyTask(Task):
    """DyFN of a pinhole model learns to double its latent; everything else is frozen.

    poison: steps whose batch holds a NaN. Parts are slices of one and the same batch.
    """

    def __init__(self, poison: tuple[int, ...] = ()) -> None:
        self.model = PinholeModel(stabilized=True)
        self.model.unit.requires_grad_(False)
        self.poison = poison

    def groups(self) -> list[dict[str, Any]]:
        assert self.model.stabilizer is not None
        return [{"params": list(self.model.stabilizer.parameters()), "lr": 1e-2}]

    def batches(self, start: int, part: int = 0, parts: int = 1) -> Iterator[Latents]:
        size = share_of(BATCH, parts, "the batch")
        step = start
        while True:
            features = uniform(step, BATCH, 3, 6, 8)[part * size : (part + 1) * size]
            yield Latents(features * (torch.nan if step in self.poison else 1.0))
            step += 1

    def images(self, batch: Latents) -> int:
        return len(batch.features)

    def loss(self, batch: Latents) -> tuple[Tensor, dict[str, float]]:
        changed, _ = self.model.stabilize(batch.features * self.model.unit, None)
        loss = (changed - 2 * batch.features).square().mean()
        return loss, {"loss": float(loss.detach())}

    def validate(self) -> dict[str, float]:
        batch = Latents(torch.full((1, 3, 6, 8), 0.25).cumsum(-1))
        return {"score": self.loss(batch)[1]["loss"]}

    def picture(self, batch: Latents) -> np.ndarray:
        return np.zeros((8, 8, 3), np.uint8)


def toy_config(**changes: Any) -> RunConfig:
    """Settings of a toy run; six steps unless told otherwise."""
    settings: dict[str, Any] = {
        "data": ["unused"],
        "stages": [{"from_step": 0, "batch": BATCH, "sizes": [[32, 32]]}],
        "steps": 6,
        "threads": 1,
        "device": "cpu",
        "warmup_steps": 2,
        "log_every": 1,
        "picture_every": 4,
        "validate_every": 3,
        "checkpoint_minutes": 1e-9,  # after every step
    }
    return RunConfig(**{**settings, **changes})


def run_toy(out: Path, resume: bool = False, **changes: Any) -> Trainer:
    """A toy run to its end."""
    torch.manual_seed(1)
    config = toy_config(**changes)
    trainer = Trainer(ToyTask(), config, out, resume, Processes(config))
    trainer.train()
    return trainer


def tiny_base(place: Path) -> MiniModel:
    """A random model, saved as base.safetensors, whose depth depends on its latent."""
    torch.manual_seed(0)
    config = MiniConfig(latent_channels=8, stage_channels=(8, 8), context_channels=12, num_tokens=8)
    model = MiniModel(config).eval()
    redraw([model.decoder.points[2].weight], 0.1, seed=0)  # type: ignore[list-item]
    save_model(model, place / "base.safetensors")
    return model


def tiny_dyfn_settings(place: Path) -> dict[str, Any]:
    """Settings of `dyfn-train dyfn` for tiny_base, unrolled; with rendered clips made in data/."""
    write_shard(place / "data", "a_1", "clip", "train", 8, seed=2)
    write_shard(place / "data", "b_1", "clip", "held_out", 5, seed=4)
    return {
        "base": str(place / "base.safetensors"),
        "data": [str(place / "data")],
        "stages": [{"from_step": 0, "batch": 1, "sizes": [[32, 64]]}],
        "dyfn": {"hidden": 4, "pool": 2, "form": "residual"},
        "method": {
            "kind": "unrolled",
            "cache_draws": 1,
            "cache_length": 4,
            "length": 3,
            "clips": 1,
            "strides": [1, 2],
            "objective": {"kind": "terms", "decoded": 2},
        },
        "steps": 2,
        "threads": 1,
        "device": "cpu",
        "validation_clips": 1,
    }


def environment() -> dict[str, str]:
    """What a subprocess needs to find this module and to compute as this process does."""
    places = [str(Path(__file__).parents[2]), *filter(None, sys.path)]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(places), "OMP_NUM_THREADS": "1"}


def wait_for_step(process: subprocess.Popen[bytes], out: Path, step: int) -> None:
    """Until the run has logged a step. Looks at the log, which is what a user could look at."""
    end = time.monotonic() + PATIENCE
    log = out / "log.jsonl"
    while not (log.exists() and f'"step": {step},' in log.read_text()):
        assert process.poll() is None, "the run ended before it was killed"
        assert time.monotonic() < end, f"no step {step} within {PATIENCE} s"
        time.sleep(0.002)


if __name__ == "__main__":
    run_toy(Path(sys.argv[1]), sys.argv[2] == "resume", **json.loads(sys.argv[3]))
