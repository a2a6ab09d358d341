"""Measured in turns, so that a busy machine disturbs all alike: ratios of one run.

Times are those of the processor on one thread. A round runs every contestant once, on the same
input, each round beginning with another one. A ratio is the median over the rounds of the ratios
within a round.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch.utils.flop_counter import FlopCounterMode, conv_flop_count

WARM = 2  # rounds that are not counted
_SIDE = 1024  # of a matrix product
_CHANNELS, _PIXELS = 128, 96  # of a 3 x 3 convolution

Contestant = Callable[[int], float | None]


@dataclass(frozen=True)
class Measured:
    """One contestant.

    Attributes:
        milliseconds: Median of the processor's time.
        ratio: To the first contestant; median over rounds.
        low, high: Quartiles of the ratio.
        floor: Milliseconds that its multiplications alone take at the speed of matrix products;
            None where they were not counted.
    """

    milliseconds: float
    ratio: float
    low: float
    high: float
    floor: float | None = None

    def values(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def measured(
    contestants: Mapping[str, Contestant], rounds: int, flops: Mapping[str, float] | None = None
) -> dict[str, Measured]:
    """Run the contestants in turns.

    Args:
        contestants: By name; each takes the round's number, and may return its own time in
            seconds, where another process does the work.
        rounds: That count.
        flops: Of those whose floor is wanted.

    Returns:
        By name, in the order given; ratios are to the first one.
    """
    flops = flops or {}
    everyone: dict[str, Contestant] = {**contestants}
    if flops:
        everyone |= {name: run for name, (run, _) in _PROBES.items()}
    names = list(everyone)
    spent: dict[str, list[float]] = {name: [] for name in names}
    for number in range(rounds + WARM):
        start = number % len(names)
        for name in [*names[start:], *names[:start]]:
            before = time.process_time()
            own = everyone[name](number)
            seconds = time.process_time() - before if own is None else own
            if number >= WARM:
                spent[name].append(max(seconds, 1e-9))
    rate = None
    if flops:
        rate = max(work / statistics.median(spent[name]) for name, (_, work) in _PROBES.items())
    return {
        name: _measured(spent[name], spent[names[0]], _floor(flops.get(name), rate))
        for name in contestants
    }


def _product(_: int) -> None:
    torch.mm(_MATRIX, _MATRIX)


@torch.inference_mode()
def _convolution(_: int) -> None:
    F.conv2d(_PICTURE, _KERNEL, padding=1)


_MATRIX = torch.rand(_SIDE, _SIDE)
_PICTURE = torch.rand(1, _CHANNELS, _PIXELS, _PIXELS)
_KERNEL = torch.rand(_CHANNELS, _CHANNELS, 3, 3)
# What shows how fast this processor multiplies, and how many operations that is.
_PROBES: dict[str, tuple[Contestant, float]] = {
    "matrix product": (_product, 2.0 * _SIDE**3),
    "convolution": (_convolution, 2.0 * 9 * (_CHANNELS * _PIXELS) ** 2),
}


def _floor(flops: float | None, rate: float | None) -> float | None:
    return None if flops is None or rate is None else 1e3 * flops / rate


def _measured(seconds: list[float], base: list[float], floor: float | None) -> Measured:
    ratios = [mine / other for mine, other in zip(seconds, base, strict=True)]
    low, middle, high = statistics.quantiles(ratios, n=4, method="inclusive")
    return Measured(1e3 * statistics.median(seconds), middle, low, high, floor)


def counted(call: Callable[[], object]) -> float:
    """Floating-point operations of the matrix products and convolutions of a call."""

    def convolution(
        x: Any, weight: Any, *_: Any, out_shape: Any = None, **__: Any
    ) -> int:  # FlopCounterMode does not know oneDNN's
        return int(conv_flop_count(x, weight, out_shape))

    own = {torch.ops.aten.mkldnn_convolution: convolution}
    with FlopCounterMode(display=False, custom_mapping=own) as counter:
        call()
    return float(counter.get_total_flops())
