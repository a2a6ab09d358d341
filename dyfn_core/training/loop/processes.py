"""Devices, precision and processes of a run, through Hugging Face accelerate.

A step's batch is computed in equal parts, each with its own random draws. Processes share the
parts out among themselves; one process computes them one after the other. The sum of gradients,
and so the run, is the same either way.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import fields, replace
from datetime import timedelta
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor, nn

from dyfn_core.training.config import ConfigError, LoopConfig

if TYPE_CHECKING:
    from accelerate import Accelerator

Batch = TypeVar("Batch")
Loss = Callable[[Any], tuple[Tensor, dict[str, float]]]
PART_STRIDE = 2**40  # between the random seeds of the parts of one step
# Others wait so long while one process makes its share of a cache, or validates.
PATIENCE = timedelta(hours=3)


class LossModule(nn.Module):
    """A task's loss as a module's forward, which is what data parallelism can wrap."""

    def __init__(self, model: nn.Module, loss: Loss) -> None:
        super().__init__()
        self.model = model
        self.loss = loss

    def forward(self, batch: Any) -> tuple[Tensor, dict[str, float]]:
        return self.loss(batch)


class Processes:
    """This process among those of the run: alone, or one of those that a launcher started.

    Raises ConfigError when the parts of a batch cannot be shared out equally.
    """

    def __init__(self, config: LoopConfig) -> None:
        # Importing it takes seconds, which commands that train nothing need not pay.
        from accelerate import Accelerator
        from accelerate.utils import InitProcessGroupKwargs

        # Without a GPU, accelerate joins processes over gloo only if told that it is the CPU.
        self.accelerator: Accelerator = Accelerator(
            cpu=config.device == "cpu" or not _any_gpu(),
            mixed_precision=config.mixed_precision,
            kwargs_handlers=[InitProcessGroupKwargs(timeout=PATIENCE)],
        )
        torch.set_num_threads(config.threads)
        self.count = self.accelerator.num_processes
        self.index = self.accelerator.process_index
        self.parts = config.parts or self.count
        if self.parts % self.count:
            raise ConfigError(f"parts ({self.parts}) must be a multiple of {self.count} processes")
        self.own_parts = range(self.index, self.parts, self.count)

    @property
    def is_main(self) -> bool:
        """Whether this process writes the run's files."""
        return bool(self.accelerator.is_main_process)

    @property
    def device(self) -> torch.device:
        """Where this process computes."""
        found: torch.device = self.accelerator.device
        return found

    def wait(self) -> None:
        """Until every process is here."""
        self.accelerator.wait_for_everyone()

    def wrap(self, model: nn.Module, loss: Loss) -> nn.Module:
        """The loss as a module whose gradients are averaged over the processes."""
        wrapped: nn.Module = self.accelerator.prepare(LossModule(model, loss))
        return wrapped

    def backward(
        self, module: nn.Module, batches: list[Any], seed: int
    ) -> tuple[float, dict[str, float]]:
        """Gradients of the mean loss over all parts of all processes.

        batches: this process's parts. seed: of the step; every part has draws of its own.
        Returns the sum of this process's losses and the mean of its logged values.
        """
        total, sums = 0.0, dict[str, float]()
        for index, (part, batch) in enumerate(zip(self.own_parts, batches, strict=True)):
            torch.manual_seed(seed + PART_STRIDE * part)
            last = index == len(batches) - 1
            quiet = contextlib.nullcontext() if last else self.accelerator.no_sync(module)
            with quiet:
                loss, values = module(to_device(batch, self.device))
                self.accelerator.backward(loss / len(batches))
            total += float(loss.detach())
            for name, value in values.items():
                sums[name] = sums.get(name, 0.0) + value / len(batches)
        return total, sums

    def agree(self, finite: bool, stop: bool, seconds: float) -> tuple[bool, bool, float]:
        """(every process finite, any wants to stop, the main process's clock)."""
        if self.count == 1:
            return finite, stop, seconds
        own = torch.tensor([[float(finite), float(stop), seconds]], dtype=torch.float64)
        every = self.accelerator.gather(own.to(self.device)).cpu()
        return bool(every[:, 0].all()), bool(every[:, 1].any()), float(every[0, 2])

    def mean(self, values: dict[str, float]) -> dict[str, float]:
        """The mean over the processes of values that all of them have."""
        if self.count == 1:
            return values
        own = torch.tensor([values[name] for name in sorted(values)], dtype=torch.float64)
        every = self.accelerator.reduce(own.to(self.device), "mean").tolist()
        return dict(zip(sorted(values), every, strict=True))

    def clip(self, parameters: list[nn.Parameter], limit: float) -> float:
        """Clip the gradients' norm; returns what it was."""
        norm = self.accelerator.clip_grad_norm_(parameters, limit)
        return math.nan if norm is None else float(norm)

    def skip(self) -> None:
        """What a step that is not taken owes to the loss scaling of float16."""
        if self.accelerator.scaler is not None:
            self.accelerator.scaler.update()


def to_device(batch: Batch, device: torch.device) -> Batch:
    """A dataclass with its tensors on the device; itself on the CPU."""
    if device.type == "cpu":
        return batch
    values = {field.name: getattr(batch, field.name) for field in fields(batch)}  # type: ignore[arg-type]
    tensors = {name: value for name, value in values.items() if isinstance(value, Tensor)}
    moved = {name: value.to(device, non_blocking=True) for name, value in tensors.items()}
    return replace(batch, **moved)  # type: ignore[type-var]


def full_precision(like: Tensor) -> torch.autocast:
    """Inside, mixed precision is off: alignments and 1 / z errors need float32."""
    return torch.autocast(like.device.type, enabled=False)


def own_place() -> tuple[int, int]:
    """This process's index and how many there are, once Processes has joined them."""
    group = torch.distributed
    if group.is_available() and group.is_initialized():
        return group.get_rank(), group.get_world_size()
    return 0, 1


def wait_for_every_process() -> None:
    """Until every process is here; at once when there is one."""
    if own_place()[1] > 1:
        from accelerate import PartialState

        PartialState().wait_for_everyone()


def share_of(total: int, parts: int, name: str) -> int:
    """How much of a batch is one part. Raises ConfigError when the parts would differ."""
    if total % parts:
        raise ConfigError(f"{name} ({total}) cannot be split into {parts} equal parts")
    return total // parts


def part_seed(seed: int, part: int) -> int:
    """The seed of one part's draws; that of the only part is the run's."""
    return seed + 1_000_003 * part


def _any_gpu() -> bool:
    xpu = getattr(torch, "xpu", None)
    found = torch.cuda.is_available() or torch.backends.mps.is_available()
    return found or (xpu is not None and xpu.is_available())
