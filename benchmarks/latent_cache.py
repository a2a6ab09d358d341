"""What the frozen-latent cache buys: steps of DyFN training with it and without, in one run.

    python benchmarks/latent_cache.py CONFIG [--steps N] [--set KEY=VALUE ...]

CONFIG is one of `dyfn-train dyfn`, method unrolled. Both ways take the same optimizer steps on
batches of the same shape; without a cache every step renders, augments and encodes clips of its
own. Blocks of steps alternate between the two, so that whatever else the machine does hits both.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import torch

from dyfn_core.training.config import read_config
from dyfn_core.training.dyfn_config import DyFNRunConfig, UnrolledMethod
from dyfn_core.training.tasks.dyfn_unrolled import UnrolledTask


class Way:
    """A task with an optimizer of its own, timed step by step."""

    def __init__(self, task: UnrolledTask) -> None:
        self.task = task
        self.optimizer = torch.optim.AdamW(task.groups())
        self.batches: Iterator[Any] = task.batches(0)
        self.times: list[float] = []

    def step(self) -> None:
        """One step, waiting for its batch included."""
        start = time.perf_counter()
        loss, _ = self.task.loss(next(self.batches))
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.times.append(time.perf_counter() - start)


def main() -> None:
    """Run and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("config", type=Path)
    parser.add_argument("--steps", type=int, default=24)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    sets = ["method.cache_draws=4", *options.set]
    with tempfile.TemporaryDirectory() as folder:
        config = read_config(options.config, DyFNRunConfig, sets)
        without = read_config(options.config, DyFNRunConfig, [*sets, "method.cache_draws=0"])
        torch.set_num_threads(config.threads)
        start = time.perf_counter()
        cached = Way(UnrolledTask(config, Path(folder)))
        built = time.perf_counter() - start
        fresh = Way(UnrolledTask(without, Path(folder)))
        for block in range(options.steps // 4 + 1):
            for way in (cached, fresh):
                for _ in range(4 if block else 1):  # the first block warms up
                    way.step()
    with_cache, no_cache = median(cached.times[1:]), median(fresh.times[1:])
    assert isinstance(config.method, UnrolledMethod)
    frames = config.method.cache_draws * config.stages[0].batch * config.method.cache_length
    print("| | median step | steps/s | ratio |\n| --- | --- | --- | --- |")
    print(f"| no cache | {1000 * no_cache:.0f} ms | {1 / no_cache:.2f} | 1.0 |")
    ratio = no_cache / with_cache
    print(f"| cached latents | {1000 * with_cache:.0f} ms | {1 / with_cache:.2f} | {ratio:.1f} |")
    print(f"\nBuilding the cache: {frames} frames in {built:.1f} s, model loading included.")


if __name__ == "__main__":
    main()
