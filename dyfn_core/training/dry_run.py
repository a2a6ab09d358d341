"""What a run would cost on this machine, found by a step of each stage on made clips."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import torch

from dyfn_core.data.clips import ClipBatch
from dyfn_core.training.dyfn_config import DyFNRunConfig, UnrolledMethod, stage_sizes
from dyfn_core.training.loop.processes import share_of, to_device
from dyfn_core.training.tasks.dyfn_unrolled import UnrolledTask
from dyfn_core.training.tasks.latent_cache import encode_clips


@dataclass(frozen=True)
class StageCost:
    """What a stage costs in one process.

    Attributes:
        steps: Its steps.
        size: Height and width of its largest image.
        encode_seconds: Of a step's clips through the frozen encoder, which a cache does once.
        step_seconds: Of a step, without the encoder.
        memory: Bytes that the process has held at most, of the GPU if it computes on one.
    """

    steps: int
    size: tuple[int, int]
    encode_seconds: float
    step_seconds: float
    memory: int


def stage_costs(task: UnrolledTask, config: DyFNRunConfig) -> Iterator[StageCost]:
    """Take one step of each stage with its largest images, after one that is not timed.

    Args:
        task: A task without a cache of latents.
        config: Its settings.

    Yields:
        The cost of each stage.
    """
    assert isinstance(config.method, UnrolledMethod)
    parts = config.parts or 1
    clips = share_of(config.method.clips, parts, "clips")
    starts = [min(stage.from_step, config.steps) for stage in config.stages] + [config.steps]
    for stage, (start, end) in zip(config.stages, pairwise(starts), strict=True):
        size = max(stage_sizes(stage), key=lambda size: size[0] * size[1])
        tokens = None if stage.tokens is None else stage.tokens[1]
        batch = made_clips(clips, config.method.length, size, tokens)
        for _ in range(2):
            began = time.perf_counter()
            latents = encode_clips(task.model, batch)
            encoded = time.perf_counter()
            loss, _ = task.loss(to_device(latents, task.model.device))
            loss.backward()
            if task.model.device.type == "cuda":
                torch.cuda.synchronize()
            done = time.perf_counter()
        seconds = (parts * (encoded - began), parts * (done - encoded))
        yield StageCost(end - start, size, *seconds, _peak_memory(task.model.device))


def made_clips(clips: int, length: int, size: tuple[int, int], tokens: int | None) -> ClipBatch:
    """Clips of noise before a wavy wall: they cost what real ones do."""
    height, width = size
    draw = torch.Generator().manual_seed(0)
    image = torch.randint(256, (clips, length, 3, height, width), generator=draw)
    wall = 2 + torch.sin(torch.arange(width // 2) / 9) + torch.arange(height // 2)[:, None] / height
    depth = wall.expand(clips, length, height // 2, width // 2).float()
    intrinsics = torch.tensor([1.0, width / height, 0.5, 0.5]).expand(clips, length, 4)
    return ClipBatch(image.to(torch.uint8), depth.contiguous(), intrinsics.contiguous(), tokens)


def report(costs: list[StageCost], cached: bool) -> str:
    """Say what a run costs.

    Args:
        costs: Of its stages.
        cached: Whether latents are encoded once, into a cache.

    Returns:
        A line for each stage and one for the whole run.
    """
    lines, total = [], 0.0
    for cost in costs:
        seconds = cost.step_seconds + (0 if cached else cost.encode_seconds)
        total += cost.steps * seconds
        lines.append(
            f"{cost.steps} steps with images up to {cost.size[0]} x {cost.size[1]}: "
            f"{seconds:.2f} s a step (encoder {cost.encode_seconds:.2f} s"
            f"{', once for the cache' if cached else ''}), {cost.memory / 2**30:.2f} GiB"
        )
    lines.append(
        f"{sum(cost.steps for cost in costs)} steps: {total / 3600:.2f} hours at most in one "
        "process, without reading, validation and pictures"
    )
    return "\n".join(lines)


def _peak_memory(device: torch.device) -> int:
    if device.type == "cuda":
        return int(torch.cuda.max_memory_allocated(device))
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
