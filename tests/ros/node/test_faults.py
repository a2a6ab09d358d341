"""Every row of docs/faults.md, done to the node."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.support.faults.bench import Bench
from tests.support.faults.fault import Fault, run
from tests.support.faults.table import KINDS, MANUAL, Kind, written
from tests.support.ros_graph import own_domain

ROOT = Path(__file__).parents[3]
FAULTS = [(kind, fault) for kind in KINDS for fault in kind.faults]


@pytest.fixture(scope="module")
def bench_of() -> Iterator[Callable[[Kind], Bench]]:
    """One node for all faults of a kind; the next kind's ends it."""
    now: list[tuple[Kind, Bench]] = []
    with ExitStack() as stack:

        def bench_of(kind: Kind) -> Bench:
            if not now or now[-1][0] is not kind:
                stack.pop_all().close()
                now.clear()
                domain = stack.enter_context(own_domain())
                now.append((kind, stack.enter_context(kind.open(domain))))
            return now[-1][1]

        yield bench_of


@pytest.mark.parametrize(
    ("kind", "fault"),
    FAULTS,
    ids=[f"{kind.title}: {fault.name}"[:60] for kind, fault in FAULTS],
)
def test_the_node_survives_or_refuses_clearly(
    bench_of: Callable[[Kind], Bench], kind: Kind, fault: Fault
) -> None:
    run(fault, bench_of(kind))


def test_the_manual_has_exactly_these_rows() -> None:
    """Run `make faults` after a change of them."""
    results = {True: "refused clearly", False: "survived"}
    assert written((ROOT / MANUAL).read_text("utf-8")) == {
        kind.title: {fault.name: results[fault.refused] for fault in kind.faults} for kind in KINDS
    }
