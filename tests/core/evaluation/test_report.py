"""The report: bounded, readable without script, and right about the worst frames."""

from __future__ import annotations

import json
import re
from array import array
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from dyfn_core.evaluation.report.curves import curves_html, decimate, histogram_html
from dyfn_core.evaluation.report.html import (
    Curves,
    Histogram,
    KeyFigure,
    KeyFigures,
    Section,
    write_report,
)
from dyfn_core.evaluation.report.sequence import sequence_sections
from dyfn_core.evaluation.report.worst_frames import KEPT, STRETCHES
from dyfn_core.evaluation.sequence import SequenceEvaluation

LONG = 20_000


def evaluation(
    factors: np.ndarray, truth: bool = True, expected: int | None = None
) -> SequenceEvaluation:
    """Frames of one slanted plane whose prediction is off by a factor each."""
    made = SequenceEvaluation(expected or len(factors))
    plane = np.tile(np.linspace(1, 4, 32, dtype=np.float32), (24, 1))
    image = np.full((24, 32, 3), 90, np.uint8)
    for index, factor in enumerate(factors):
        depth, valid = plane * np.float32(factor), np.ones(plane.shape, bool)
        known = plane if truth else None
        made.push(image, depth, valid, known, stamp=5 + index / 10, latency=0.01 + index * 1e-5)
    return made


def test_decimation_keeps_extremes_and_gaps() -> None:
    values = np.sin(np.arange(LONG) / 500)
    values[12_345], values[777] = 9.0, -7.0
    values[15_000:16_000] = np.nan
    runs = decimate(list(values))
    points = [point for run in runs for point in run]
    assert len(points) <= 800 and len(runs) == 2
    assert (12_345, 9.0) in points and (777, -7.0) in points
    assert [x for x, _ in points] == sorted(x for x, _ in points)
    assert all(values[x] == y for x, y in points)
    short = decimate([1.0, None, 3.0, float("nan"), 2.0, 2.5])
    assert short == [[(0, 1.0)], [(2, 3.0)], [(4, 2.0), (5, 2.5)]]
    assert decimate([]) == decimate([None]) == []


def test_a_curve_holds_its_values_for_the_script() -> None:
    page = curves_html(Curves("a < b", {"</script>x": [1.0, None, 2.5], "y": [3.0, 3.0, 3.0]}))
    assert "a &lt; b" in page and page.count("</script>") == 1
    found = re.search(r'<script type="application/json">(.*?)</script>', page)
    assert found is not None
    data = json.loads(found.group(1))
    assert data["lines"][0] == {"name": "</script>x", "points": [[0, 1.0], [2, 2.5]]}
    assert data["ends"] == [0, 2]
    assert page.count('class="plot"') == 2 and "NaN" not in page and "nan" not in page
    assert "<svg" in curves_html(Curves("nothing", {"x": [None, None]}))


def test_a_histogram_bears_outliers_and_equal_values() -> None:
    page = histogram_html(
        Histogram("t", {"x": [5.0] * 999 + [1e6]}, "ms", {"x": {"p50": 5.0, "p99": 5.0}})
    )
    assert "p50" in page and "nan" not in page.lower().replace("finance", "")
    assert histogram_html(Histogram("t", {"x": []}, "ms", {})) == ""


class Checker(HTMLParser):
    """Whether tags are closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: object) -> None:
        pass


def test_with_and_without_stand_in_one_page(tmp_path: Path) -> None:
    drift = np.exp(0.3 * np.sin(np.arange(40) / 3))
    drift[17] = 4.0
    runs = {"with": evaluation(np.ones(40)), "without": evaluation(drift)}
    cloud = np.zeros((8, 8, 3), np.uint8)
    sections = sequence_sections(runs, {"fused": cloud}, base="without")
    write_report(tmp_path / "r.html", "Both", sections)
    page = (tmp_path / "r.html").read_text()
    checker = Checker()
    checker.feed(page)
    assert not checker.open
    assert [s.title for s in sections] == [
        "At a glance",
        "Frames",
        "Over time",
        "Scores",
        "Cloud, fused",
        "Worst frames, with",
        "Latency",
    ]
    assert "without" in page and "6.70 s" not in page  # the worst frames of the base are its own
    assert page.count("data:image/") == 6 * 6 + 1 + 6 * 4
    assert "http" not in page and "prefers-color-scheme: dark" in page
    without_script = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert without_script.count('role="img"') == 5 and "p99" in without_script


def test_the_worst_frame_is_found_whatever_the_alignment() -> None:
    for outlier in (0.3, 3.0):
        factors = np.ones(200)
        factors[[60, 140]] = outlier
        run = evaluation(factors)
        errors = run.column("video_abs_rel")
        worst = run.worst.choose(errors, 2)
        assert worst == [60, 140]
        for index in worst:
            kept = run.worst.nearest(index, errors)
            assert kept is not None and kept.index == index


def test_memory_of_the_worst_is_bounded_also_when_the_count_was_wrong() -> None:
    run = evaluation(1 + np.arange(300) / 300, expected=10)
    assert sum(len(kept) for kept in run.worst._kept) <= 3 * KEPT
    assert run.worst.stretch == 1 and STRETCHES > KEPT


def test_without_truth_there_is_no_error_but_a_report(tmp_path: Path) -> None:
    sections = sequence_sections({"run": evaluation(np.ones(3), truth=False)})
    assert [s.title for s in sections] == ["At a glance", "Frames", "Latency"]
    write_report(tmp_path / "r.html", "t", sections)


class LongRun(SequenceEvaluation):
    """Columns as of a recording of LONG frames, pictures as of a noisy one."""

    def column(self, name: str) -> np.ndarray:
        scale, shift, error = np.random.default_rng(0).lognormal(size=(3, LONG))
        errors = {"video_abs_rel": error, "image_abs_rel": error / 2, "metric_abs_rel": error * 3}
        times = {"latency_ms": 20 + scale, "stamp": np.arange(LONG) / 30}
        return {"video_ratio": scale, "shift": shift, **errors, **times}[name]


def test_a_long_recording_has_a_small_report(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    runs = {}
    for name in ("with", "without"):
        run = LongRun(LONG)
        for index in np.linspace(0, LONG - 1, 40).round().astype(int):
            run._stamps = array("d", [0.0] * int(index))  # as if the frames between had been pushed
            image = rng.integers(0, 255, (240, 320, 3), np.uint8)
            truth = rng.uniform(1, 4, (240, 320)).astype(np.float32)
            run.push(image, truth, truth > 0, truth * 1.3, stamp=0.0, latency=0.02)
        runs[name] = run
    write_report(tmp_path / "r.html", "long", sequence_sections(runs))
    size = (tmp_path / "r.html").stat().st_size
    assert 100_000 < size < 2_000_000


def test_key_figures_are_escaped(tmp_path: Path) -> None:
    figures = KeyFigures([KeyFigure("a<b", "0.500", beside={"<i>": "3"}), KeyFigure("n", "3")])
    write_report(tmp_path / "r.html", "t", [Section("s", [figures])])
    page = (tmp_path / "r.html").read_text()
    assert "<span>a&lt;b</span><b>0.500</b><small>&lt;i&gt;: 3</small>" in page
    assert "<b>3</b>" in page


@pytest.mark.parametrize("count", [1, 2])
def test_short_recordings_have_curves(count: int) -> None:
    sections = sequence_sections({"run": evaluation(np.ones(count))})
    assert "Over time" in [section.title for section in sections]
