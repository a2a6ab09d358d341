"""`make bench`: ratios are those within a round, and a page keeps what is around its tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def suite(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import paired
    import performance_page

    return paired, performance_page


def test_ratios_are_those_within_a_round(suite: Any) -> None:
    """A machine that is slow in some rounds is slow for all."""
    paired, _ = suite
    slow = [1.0, 1.0, 1.0, 50.0, 1.0, 9.0, 30.0, 1.0]
    found = paired.measured(
        {"first": lambda n: 0.010 * slow[n], "second": lambda n: 0.015 * slow[n]}, rounds=6
    )
    assert found["first"].ratio == 1
    assert found["second"].ratio == pytest.approx(1.5)
    assert found["second"].high == pytest.approx(1.5)


def test_operations_are_counted_and_give_a_floor(suite: Any) -> None:
    paired, _ = suite
    left, right = torch.rand(64, 32), torch.rand(32, 16)
    assert paired.counted(lambda: left @ right) == 2 * 64 * 32 * 16
    image, weight = torch.rand(1, 3, 8, 8), torch.rand(5, 3, 1, 1)
    arguments = (image, weight, None, (0, 0), (1, 1), (1, 1), 1)
    assert paired.counted(lambda: torch.ops.aten.mkldnn_convolution(*arguments)) == 2 * 64 * 3 * 5
    found = paired.measured({"one": lambda _: 0.1}, rounds=2, flops={"one": 1e9})
    assert 0 < found["one"].floor < 1e5
    assert set(found) == {"one"}


def test_a_page_keeps_what_is_around_its_tables(suite: Any, tmp_path: Path) -> None:
    paired, page = suite
    text = BENCHMARKS.parent / "docs" / "PERFORMANCE.md"
    path = tmp_path / "page.md"
    path.write_text(text.read_text(encoding="utf-8"), encoding="utf-8")
    rows = {"bare push": paired.Measured(10, 1, 1, 1), "node": paired.Measured(12, 1.2, 1.1, 1.3)}
    page.write_page(path, {"processor": "made"}, {"node": rows}, {"node": "A sentence."})
    now = path.read_text(encoding="utf-8")
    assert "| node | 12.0 | 1.20 | 1.10 to 1.30 |" in now
    assert "Processor made." in now
    assert now.startswith("# Speed\n") and "## Replay\n" in now
    with pytest.raises(ValueError, match="no place for nothing"):
        page.write_page(path, {"processor": "made"}, {"nothing": rows}, {"nothing": ""})
