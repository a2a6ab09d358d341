"""The loop that every training run shares: steps, schedule, checkpoints, logs, validation."""

from __future__ import annotations

import json
import math
import random
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from dyfn_core.data.clips import ClipBatch
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import save_model
from dyfn_core.training.config import RunConfig
from dyfn_core.training.ema import Ema

STATE_FILE = "state.pt"
MODEL_FILE = "model.safetensors"
BEST_FILE = "best.safetensors"


class TrainingError(RuntimeError):
    """A run that cannot go on; the message says why."""


class Task(ABC):
    """What is trained: the model, its parameter groups, its loss, and how it is judged."""

    model: GeometryModel

    @abstractmethod
    def groups(self) -> list[dict[str, Any]]:
        """Parameter groups for AdamW, each with its own "lr"."""

    @abstractmethod
    def batches(self, start: int) -> Iterator[Any]:
        """Batches from step `start` on."""

    @abstractmethod
    def loss(self, batch: Any) -> tuple[Tensor, dict[str, float]]:
        """The loss to minimise, and values to log."""

    @abstractmethod
    def validate(self) -> dict[str, float]:
        """Scores; "score" (lower is better) chooses the best model."""

    @abstractmethod
    def picture(self, batch: Any) -> np.ndarray:
        """A strip of images, H x W x 3 uint8 RGB."""

    def export_model(self) -> GeometryModel:
        """The model to write; called while the averaged parameters are in place."""
        return self.model


class Trainer:
    """One run in one folder: train() goes on from the folder's checkpoint when resuming.

    The folder gets state.pt (to resume), model.safetensors (the averaged model), best.safetensors
    (the one with the best validation score), TensorBoard scalars and pictures, and log.jsonl.
    """

    def __init__(self, task: Task, config: RunConfig, out: Path, resume: bool) -> None:
        self.task, self.config, self.out = task, config, out
        torch.set_num_threads(config.threads)
        out.mkdir(parents=True, exist_ok=True)
        groups = task.groups()
        self.rates = [group["lr"] for group in groups]
        self.optimizer = torch.optim.AdamW(groups, weight_decay=config.weight_decay)
        self.trained = [p for group in groups for p in group["params"]]
        self.ema = Ema(task.model, config.ema_decay)
        self.step, self.seconds, self.bad_steps, self.best = 0, 0.0, 0, math.inf
        state = out / STATE_FILE
        if resume:
            self._load(state)
        elif state.exists():
            raise TrainingError(f"{out} already holds a run; give --resume or another folder")
        self.writer = SummaryWriter(str(out / "tensorboard"))

    def train(self, max_steps: int | None = None) -> None:
        """Run to the end of the schedule, or until the step count reaches max_steps.

        Raises TrainingError after more than `most_bad_steps` steps in a row without a finite loss.
        """
        last = min(self.config.steps, max_steps or self.config.steps)
        batches = self.task.batches(self.step)
        saved = shown = time.monotonic()
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        with Progress(*columns, TimeRemainingColumn()) as progress:
            bar = progress.add_task("training", total=last, completed=self.step)
            while self.step < last and self.progress() < 1:
                started = time.monotonic()
                batch = next(batches)
                waited = time.monotonic() - started
                values = self._step(batch)
                now = time.monotonic()
                self.step, self.seconds = self.step + 1, self.seconds + now - started
                if self.step % self.config.log_every == 0:
                    values["wait_seconds"], values["step_seconds"] = waited, now - started
                    values["rate"] = self.optimizer.param_groups[-1]["lr"]
                    self._log("train", values)
                    rate = self.config.log_every / (now - shown)
                    shown = now
                    loss = values.get("loss", math.nan)
                    label = f"loss {loss:.4f}  {rate:.2f} steps/s"
                    progress.update(bar, completed=self.step, description=label)
                if self.step % self.config.picture_every == 0:
                    self._show(batch)
                if self.step % self.config.validate_every == 0:
                    self._validate()
                if now - saved > 60 * self.config.checkpoint_minutes:
                    self.save()
                    saved = time.monotonic()
        self._validate()
        self.save()
        self.writer.close()

    def progress(self) -> float:
        """Share of the schedule that is over, by steps or by time, whichever is further."""
        share = self.step / self.config.steps
        if self.config.hours is not None:
            share = max(share, self.seconds / (3600 * self.config.hours))
        return share

    def _step(self, batch: Any) -> dict[str, float]:
        warm = min(1.0, (self.step + 1) / max(1, self.config.warmup_steps))
        cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, self.progress())))
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate * warm * (0.01 + 0.99 * cosine)
        torch.manual_seed(self.config.seed * 1_000_003 + self.step)
        self.optimizer.zero_grad(set_to_none=True)
        loss, values = self.task.loss(batch)
        finite = bool(torch.isfinite(loss))
        if finite:
            loss.backward()
            norm = torch.nn.utils.clip_grad_norm_(self.trained, self.config.clip_norm)
            values["gradient_norm"] = float(norm)
            finite = math.isfinite(values["gradient_norm"])
        self.bad_steps = 0 if finite else self.bad_steps + 1
        if self.bad_steps > self.config.most_bad_steps:
            raise TrainingError(
                f"no finite loss or gradient in {self.bad_steps} steps up to step {self.step}"
            )
        if finite:
            self.optimizer.step()
            self.ema.update()
        else:
            self._log("train", {"skipped": 1.0})
        return values

    def _validate(self) -> None:
        with self.ema.applied(), torch.no_grad():
            self.task.model.eval()
            scores = self.task.validate()
            if scores.get("score", math.inf) < self.best:
                self.best = scores["score"]
                self._export(self.out / BEST_FILE)
            self.task.model.train()
        self._log("validation", scores)

    def _show(self, batch: Any) -> None:
        with self.ema.applied(), torch.no_grad():
            self.task.model.eval()
            strip = self.task.picture(batch)
            self.task.model.train()
        self.writer.add_image("strip", strip, self.step, dataformats="HWC")
        folder = self.out / "pictures"
        folder.mkdir(exist_ok=True)
        cv2.imwrite(str(folder / f"{self.step:07d}.jpg"), strip[..., ::-1])

    def _log(self, group: str, values: dict[str, float]) -> None:
        for name, value in values.items():
            self.writer.add_scalar(f"{group}/{name}", value, self.step)
        line = {"step": self.step, "seconds": round(self.seconds, 1), "group": group, **values}
        with (self.out / "log.jsonl").open("a") as log:
            log.write(json.dumps(line) + "\n")

    def save(self) -> None:
        """Write state.pt and the averaged model, each whole or not at all."""
        state = {
            "step": self.step,
            "seconds": self.seconds,
            "best": self.best,
            "model": self.task.model.state_dict(),
            "optimizer": self._moments(),
            "ema": self.ema.state_dict(),
            "config": self.config.model_dump(mode="json"),
            "torch_rng": torch.get_rng_state(),
            "numpy_rng": json.dumps(np.random.get_state(legacy=False), default=np.ndarray.tolist),
            "python_rng": random.getstate(),
        }
        partial = self.out / (STATE_FILE + ".partial")
        torch.save(state, partial)
        partial.replace(self.out / STATE_FILE)
        with self.ema.applied():
            self._export(self.out / MODEL_FILE)

    def _moments(self) -> dict[str, dict[str, Tensor]]:
        """AdamW's state by parameter name, so that a resumed run may freeze other parts."""
        return {
            name: dict(self.optimizer.state[parameter])
            for name, parameter in self.task.model.named_parameters()
            if parameter in self.optimizer.state
        }

    def _restore_moments(self, moments: dict[str, dict[str, Tensor]]) -> None:
        trained = {id(parameter) for parameter in self.trained}
        for name, parameter in self.task.model.named_parameters():
            if name in moments and id(parameter) in trained:
                self.optimizer.state[parameter] = dict(moments[name])

    def _export(self, path: Path) -> None:
        notes = {"trained_steps": str(self.step), "trained_seconds": f"{self.seconds:.0f}"}
        save_model(self.task.export_model(), path, notes=notes)

    def _load(self, path: Path) -> None:
        if not path.exists():
            raise TrainingError(f"nothing to resume: no {path}")
        state = torch.load(path, map_location="cpu", weights_only=True)
        self.task.model.load_state_dict(state["model"], strict=True)
        self._restore_moments(state["optimizer"])
        self.ema.load_state_dict(state["ema"])
        self.step, self.seconds = int(state["step"]), float(state["seconds"])
        self.best = float(state["best"])
        torch.set_rng_state(state["torch_rng"])
        np.random.set_state(json.loads(state["numpy_rng"]))
        version, internal, gauss = state["python_rng"]
        random.setstate((version, tuple(internal), gauss))


def picture_rows(batch: ClipBatch, depth: Tensor, count: int = 6) -> np.ndarray:
    """Image, true depth and predicted depth (B x h x w) of the first frames, one column each."""
    columns = []
    for index in range(min(count, len(depth))):
        image = batch.image[index, 0].permute(1, 2, 0).numpy()
        size = (image.shape[1], image.shape[0])
        true, ours = batch.depth[index, 0].numpy(), depth[index].numpy()
        columns.append(np.vstack([image, coloured_depth(true, size), coloured_depth(ours, size)]))
    return np.hstack(columns)


def coloured_depth(depth: np.ndarray, size: tuple[int, int] | None = None) -> np.ndarray:
    """H x W depth -> RGB, near red, far blue, invalid black; resized to (width, height)."""
    valid = np.isfinite(depth) & (depth > 0)
    near = np.zeros_like(depth)
    near[valid] = 1 / depth[valid]
    low, high = np.percentile(near[valid], [2, 98]) if valid.any() else (0.0, 1.0)
    scaled = np.clip((near - low) / max(high - low, 1e-9), 0, 1)
    coloured = cv2.applyColorMap((255 * scaled).astype(np.uint8), cv2.COLORMAP_TURBO)
    coloured[~valid] = 0
    rgb = np.ascontiguousarray(coloured[..., ::-1])
    return rgb if size is None else cv2.resize(rgb, size, interpolation=cv2.INTER_NEAREST)
