"""A fault, and the row of the table that comes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tests.support.faults.bench import RAW, Bench


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong.

    name: as the table has it. do: does it to the node, asserts what must hold meanwhile, and
    -> what came of it, in words. says: regular expressions, each of which must match a line of the
    log, the diagnostics or an answer that comes after. refused: the node took nothing of it, and
    said so; else it went on with it. camera: whose depth must be right again. within: pictures
    until then.
    """

    name: str
    do: Callable[[Bench], str]
    says: tuple[str, ...] = ()
    refused: bool = False
    camera: str = RAW
    within: int = 1


@dataclass(frozen=True)
class Row:
    """What happened.

    gave: what came of it. said: by the node, as it stands in its log. frames, seconds: from the
    fault's end until a picture had the right depth.
    """

    name: str
    refused: bool
    gave: str
    said: tuple[str, ...]
    frames: int
    seconds: float

    @property
    def result(self) -> str:
        return "refused clearly" if self.refused else "survived"


def run(fault: Fault, bench: Bench) -> Row:
    """Do it to the node, and wait until the depth is right again.

    Raises AssertionError when the node does not say what it should, gives wrong depth, or needs
    more pictures than the fault allows.
    """
    assert all(len(pattern) > 8 for pattern in fault.says), "a pattern that says too little"
    assert fault.says or not fault.refused, "a refusal without a word"
    before = bench.recover(fault.camera)
    assert before.frames == 1, f"the node is not well before this: {before}"
    since = len(bench.said)
    failed = bench.node._callback_errors
    gave = fault.do(bench)
    recovery = bench.recover(fault.camera)
    said = tuple(bench.wait_said(pattern, since) for pattern in fault.says)
    assert recovery.frames <= fault.within, f"{recovery.frames} pictures until the depth was right"
    assert bench.node._callback_errors == failed, bench.said[since:]
    return Row(fault.name, fault.refused, gave, said, recovery.frames, recovery.seconds)
