"""The loop that every training run shares: steps, schedule, checkpoints, logs, validation."""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path
from typing import Any

import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from dyfn_core.models.checkpoints import save_model
from dyfn_core.training.config import LoopConfig
from dyfn_core.training.former_config import former_command, translated
from dyfn_core.training.loop.checkpoint import (
    STATE_FILE,
    DamagedCheckpointError,
    has_state,
    read_state,
    write_state,
)
from dyfn_core.training.loop.ema import Ema
from dyfn_core.training.loop.processes import Processes
from dyfn_core.training.loop.run_folder import RunFolder
from dyfn_core.training.loop.run_state import (
    moments,
    random_state,
    restore_moments,
    restore_random_state,
)
from dyfn_core.training.loop.signals import StopSignals
from dyfn_core.training.tasks.task import Task

MODEL_FILE = "model.safetensors"
BEST_FILE = "best.safetensors"
MOST_TOLD = 10  # messages about clips that could not be read, at the end of a run
COUNTERS = ("step", "seconds", "images", "best", "stale", "bad_steps", "skipped_steps")

logger = logging.getLogger(__name__)


class TrainingError(RuntimeError):
    """A run that cannot go on; the message says why."""


class InterruptedRunError(RuntimeError):
    """A run that a signal ended after a checkpoint. number: the signal's."""

    def __init__(self, message: str, number: int) -> None:
        super().__init__(message)
        self.number = number


def check_folder(out: Path, resume: bool) -> None:
    """Raises TrainingError when a folder holds a run already, or none to resume."""
    if resume and not has_state(out):
        raise TrainingError(f"nothing to resume: {out} holds no {STATE_FILE}")
    if not resume and has_state(out):
        raise TrainingError(f"{out} already holds a run; give --resume or another folder")


class Trainer:
    """One run in one folder: train() goes on from the folder's checkpoint when resuming.

    The folder gets state.pt (to resume), model.safetensors (the averaged model), best.safetensors
    (the one with the best validation score), and what RunFolder writes. Only the main process
    writes. Raises TrainingError when the folder holds a run already, or none to resume.
    """

    def __init__(
        self,
        task: Task,
        config: LoopConfig,
        out: Path,
        resume: bool,
        processes: Processes | None = None,
    ) -> None:
        self.task, self.config, self.out = task, config, out
        self.processes = processes or Processes(config)
        task.model.to(self.processes.device)
        groups = task.groups()
        self.rates = [group["lr"] for group in groups]
        self.optimizer = torch.optim.AdamW(groups, weight_decay=config.weight_decay)
        self.trained = [p for group in groups for p in group["params"]]
        self.ema = Ema(task.model, config.ema_decay)
        self.module = self.processes.wrap(task.model, task.loss)
        self.stepper = self.processes.accelerator.prepare(self.optimizer)
        self.step, self.images, self.bad_steps, self.skipped_steps = 0, 0, 0, 0
        self.seconds, self.best, self.stale = 0.0, math.inf, 0
        self._validated = -1  # step of the last validation of this process
        self.scores: dict[str, float] = {}
        check_folder(out, resume)
        if resume:
            self._load()
        self.processes.wait()
        self.folder = self._open_folder() if self.processes.is_main else None

    def _open_folder(self) -> RunFolder:
        facts = {
            "processes": self.processes.count,
            "parts": self.processes.parts,
            "device": self.processes.device.type,
            "mixed_precision": self.config.mixed_precision,
        }
        return RunFolder(self.out, self.config, self.step, facts)

    def train(self, max_steps: int | None = None) -> None:
        """Run to the end of the schedule, or until the step count reaches max_steps.

        Raises TrainingError after more than `most_bad_steps` steps in a row without a finite
        loss and gradient, InterruptedRunError after SIGINT or SIGTERM. Both leave a checkpoint.
        """
        last = self.config.steps if max_steps is None else min(self.config.steps, max_steps)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        quiet = not self.processes.is_main
        with (
            StopSignals() as signals,
            Progress(*columns, TimeRemainingColumn(), disable=quiet) as progress,
        ):
            bar = progress.add_task("training", total=last, completed=self.step)
            stopped = self._loop(last, signals, progress, bar)
        if stopped:
            self.save()
            self._close()
            name = signals.name or "a signal to another process"
            raise InterruptedRunError(
                f"{name}: checkpoint written at step {self.step}; go on with --resume",
                signals.number or 15,
            )
        if self._validated != self.step:
            self._validate()
        self.save()
        if self.folder is not None and self.progress() >= 1:
            self.folder.results(self._summary())
        self._close()

    def _loop(self, last: int, signals: StopSignals, progress: Progress, bar: Any) -> bool:
        """Steps up to `last`; True when a signal ended them early."""
        streams = [
            self.task.batches(self.step, part, self.processes.parts)
            for part in self.processes.own_parts
        ]
        saved = shown = time.monotonic()
        while self.step < last and self.progress() < 1:
            started = time.monotonic()
            batches = [next(stream) for stream in streams]
            waited = time.monotonic() - started
            values, stop = self._step(batches, signals, started)
            if self.step % self.config.log_every == 0:
                now = time.monotonic()
                values["wait_seconds"], values["step_seconds"] = waited, now - started
                values["rate"] = self.optimizer.param_groups[-1]["lr"]
                self._log("train", self.processes.mean(values))
                label = f"loss {values.get('loss', math.nan):.4f}"
                label += f"  {self.config.log_every / (now - shown):.2f} steps/s"
                progress.update(bar, completed=self.step, description=label)
                shown = now
            if self.step % self.config.picture_every == 0:
                self._show(batches[0])
            if self.step % self.config.validate_every == 0:
                self._validate()
            if stop:
                return True
            if time.monotonic() - saved > 60 * self.config.checkpoint_minutes:
                self.save()
                saved = time.monotonic()
        return False

    def progress(self) -> float:
        """Share of the schedule that is over, by steps or by time, whichever is further; 1 when
        nothing has got better for as long as `patience` says."""
        if self.config.patience is not None and self.stale >= self.config.patience:
            return 1.0
        share = self.step / self.config.steps
        if self.config.hours is not None:
            share = max(share, self.seconds / (3600 * self.config.hours))
        return share

    def _step(
        self, batches: list[Any], signals: StopSignals, started: float
    ) -> tuple[dict[str, float], bool]:
        """One step: logged values, and whether to stop. Changes nothing if it is not finite."""
        self._set_rates()
        self.optimizer.zero_grad(set_to_none=True)
        seed = self.config.seed * 1_000_003 + self.step
        total, values = self.processes.backward(self.module, batches, seed)
        norm = self.processes.clip(self.trained, self.config.clip_norm)
        values["gradient_norm"] = norm
        finite, stop, seconds = self.processes.agree(
            math.isfinite(total) and math.isfinite(norm),
            signals.number is not None,
            self.seconds + time.monotonic() - started,
        )
        if finite:
            self.stepper.step()
            self.ema.update()
        else:
            self.processes.skip()
        self.step, self.seconds = self.step + 1, seconds
        self.images += self.processes.count * sum(map(self.task.images, batches))
        self._count_bad(finite)
        return values, stop

    def _set_rates(self) -> None:
        warm = min(1.0, (self.step + 1) / max(1, self.config.warmup_steps))
        if self.config.schedule == "halving":
            past = max(0, self.step - self.config.constant_steps)
            share = 0.5 ** (past // self.config.halve_every)
        else:
            share = 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, self.progress())))
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate * warm * share

    def _count_bad(self, finite: bool) -> None:
        self.bad_steps = 0 if finite else self.bad_steps + 1
        if finite:
            return
        self.skipped_steps += 1
        self._log("train", {"skipped": float(self.skipped_steps)})
        if self.bad_steps > self.config.most_bad_steps:
            self.save()
            self._close()
            raise TrainingError(
                f"no finite loss or gradient in {self.bad_steps} steps up to step {self.step}: "
                "the learning rate may be too high, or the data damaged; state.pt holds the "
                "last good parameters"
            )

    def _validate(self) -> None:
        if self.folder is not None:
            with self.ema.applied(), torch.no_grad():
                self.task.model.eval()
                self.scores = self.task.validate()
                better = self.scores.get("score", math.inf) < self.best
                if better:
                    self.best = self.scores["score"]
                    self._export(self.out / BEST_FILE)
                self.task.model.train()
            self.stale = 0 if better else self.stale + 1
            self._log("validation", self.scores)
        self._validated = self.step
        self.processes.wait()
        self.stale = int(self.processes.agree(True, False, float(self.stale))[2])  # main's

    def _show(self, batch: Any) -> None:
        if self.folder is not None:
            with self.ema.applied(), torch.no_grad():
                self.task.model.eval()
                strip = self.task.picture(batch)
                self.task.model.train()
            self.folder.picture(self.step, strip)

    def _log(self, group: str, values: dict[str, float]) -> None:
        if self.folder is not None:
            seconds = round(self.seconds, 1)
            self.folder.log(group, self.step, values, seconds=seconds, images=self.images)

    def _summary(self) -> dict[str, Any]:
        counters = {name: getattr(self, name) for name in COUNTERS}
        return {**counters, "unreadable_clips": self.task.unreadable.total(), **self.scores}

    def _close(self) -> None:
        worst = self.task.unreadable.most_common(MOST_TOLD)
        for message, count in worst:
            logger.warning("could not be read, %d x: %s", count, message)
        if others := self.task.unreadable.total() - sum(count for _, count in worst):
            logger.warning("could not be read, %d x: others", others)
        if self.folder is not None:
            self.folder.close()
        self.processes.wait()

    def save(self) -> None:
        """Write state.pt and the averaged model, each whole or not at all."""
        if self.folder is None:
            return
        state = {
            **{name: getattr(self, name) for name in COUNTERS},
            "unreadable": dict(self.task.unreadable),
            "model": self.task.model.state_dict(),
            "optimizer": moments(self.task.model, self.optimizer),
            "ema": self.ema.state_dict(),
            "config": self.config.model_dump(mode="json"),
            **random_state(),
        }
        write_state(self.out, state)
        with self.ema.applied():
            self._export(self.out / MODEL_FILE)

    def _export(self, path: Path) -> None:
        notes = {"trained_steps": str(self.step), "trained_seconds": f"{self.seconds:.0f}"}
        save_model(self.task.export_model(), path, notes=notes)

    def _load(self) -> None:
        try:
            state = read_state(self.out)
        except (FileNotFoundError, DamagedCheckpointError) as error:
            raise TrainingError(str(error)) from error
        self._tell_changes(state["config"])
        self.task.model.load_state_dict(state["model"], strict=True)
        restore_moments(self.task.model, self.optimizer, state["optimizer"])
        self.ema.load_state_dict(state["ema"])
        for name in COUNTERS:
            own = getattr(self, name)
            setattr(self, name, type(own)(state.get(name, own)))
        # A cache that had to be made anew has been counted by now.
        self.task.unreadable.update(state.get("unreadable", {}))
        restore_random_state(state)

    def _tell_changes(self, before: dict[str, Any]) -> None:
        now = self.config.model_dump(mode="json")
        former = former_command(before) if "method" in type(self.config).model_fields else None
        if former is not None:
            before = (
                type(self.config)
                .model_validate(translated(before, former, tell=False))
                .model_dump(mode="json")
            )
        for name in sorted({*now, *before}):
            if now.get(name) != before.get(name):
                old, new = before.get(name), now.get(name)
                logger.warning("resuming with another %s: %r, was %r", name, new, old)
