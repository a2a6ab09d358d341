"""What a report says of variants: the sentence, the key figures, curves over seconds."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest

from dyfn_core.evaluation.report.cloud_view import POINTS, CloudView, PointCloud, cloud_html
from dyfn_core.evaluation.report.colours import colour_depth
from dyfn_core.evaluation.report.curves import Curves, curves_html
from dyfn_core.evaluation.report.frame_grid import ShownFrames, frame_grid, grid_picture
from dyfn_core.evaluation.report.pictures import DepthSnapshot
from dyfn_core.evaluation.report.sequence import sequence_sections
from dyfn_core.evaluation.report.variants import (
    Role,
    Variant,
    headline,
    key_figures,
    over_time,
    seconds_axis,
)
from dyfn_core.evaluation.sequence import SequenceEvaluation, score_table


def variant(
    name: str, role: Role, drift: float | None, error: float | None, **more: Any
) -> Variant:
    scores = {
        "frames": 90,
        "drift": None if drift is None else {"log_std": drift},
        "video": None if error is None else {"abs_rel": error, "delta1": 1 - error},
        **more,
    }
    return Variant(name, role, scores)


@pytest.mark.parametrize(
    ("result", "base", "said"),
    [
        (
            (0.078, 0.1),
            (0.1, 0.2),
            "new lowers the drift of the scale by 22 % and lowers the error of the sequence by "
            "50 % against old over 90 frames (drift 0.100 to 0.078, AbsRel 0.200 to 0.100).",
        ),
        (
            (0.05, 0.3),
            (0.1, 0.2),
            "new lowers the drift of the scale by 50 % but raises the error of the sequence by "
            "50 % against old over 90 frames (drift 0.100 to 0.050, AbsRel 0.200 to 0.300).",
        ),
        (
            (0.4, 0.2),
            (0.1, 0.2),
            "new raises the drift of the scale by 4.0 times and leaves the error of the sequence "
            "as it is against old over 90 frames (drift 0.100 to 0.400, AbsRel 0.200 to 0.200).",
        ),
        (
            (0.101, 0.199),
            (0.1, 0.2),
            "new makes no difference to old over 90 frames: drift of the scale 0.100 to 0.101, "
            "AbsRel of the sequence 0.200 to 0.199.",
        ),
        (
            (0.101, 0.199),
            None,
            "The scale of new wanders by 10.1% over 90 frames (standard deviation), and its AbsRel "
            "is 0.199; no base was run beside it.",
        ),
        (
            (None, None),
            (None, None),
            "new ran over 90 frames; no frame has ground truth to compare the scale with.",
        ),
        (
            (None, 0.1),
            None,
            "new ran over 90 frames; too few frames have ground truth to compare the scale with.",
        ),
    ],
)
def test_the_sentence_says_what_the_numbers_say(
    result: tuple[float | None, float | None], base: tuple[float | None, float | None], said: str
) -> None:
    variants = [variant("new", "result", *result)]
    variants += [] if base is None else [variant("old", "base", *base)]
    assert headline(variants) == said


def test_equal_outputs_are_called_equal_and_metres_are_named() -> None:
    same = {"output_sha256": "a"}
    pair = [variant("new", "result", 1, 1, **same), variant("old", "base", 1, 1, **same)]
    assert "gave the same depth, byte for byte over 90 frames" in headline(pair)
    metric = variant("third", "result", 0.05, 0.1, metric={"abs_rel": 0.123})
    text = headline([*pair, metric])
    assert "third lowers the drift of the scale by 95 %" in text
    assert text.endswith("third is in metres: AbsRel 0.123 without any alignment.")


def test_key_figures_have_the_base_beside_and_say_which_way_is_better() -> None:
    times = {"latency_ms": {"p50": 20.0}}
    found = key_figures(
        [
            variant("new", "result", 0.05, 0.3, **times),
            variant("old", "base", 0.1, 0.2, **times),
            variant("control: ramp", "control", None, 0.4),
        ]
    ).figures
    by_name = {figure.name: figure for figure in found}
    drift, error = by_name["drift of the scale"], by_name["AbsRel of the sequence"]
    assert (drift.value, drift.beside, drift.change) == ("0.050", {"old": "0.100"}, "50 % lower")
    assert drift.better is True and error.better is False and error.change == "50 % higher"
    assert by_name["delta1 of the sequence"].better is False
    assert by_name["ms a frame (median)"].change == "no difference"
    assert by_name["frames"].value == "90" and "AbsRel in metres, not aligned" not in by_name


def test_curves_are_over_seconds_and_controls_do_not_stretch_them() -> None:
    page = curves_html(
        Curves("t", {"a": [1, 2, 3], "control": [900.0, 0, 0]}, "s", "m", [0, 0.5, 4], {"control"})
    )
    found = re.search(r'<script type="application/json">(.*?)</script>', page)
    assert found is not None
    data = json.loads(found.group(1))
    assert data["ends"] == [0, 4] and data["lines"][0]["points"] == [[0, 1], [0.5, 2], [4, 3]]
    assert page.count("var(--muted)") == 2 and page.count("var(--c0)") == 2
    ticks = [float(t) for t in re.findall(r'text-anchor="end">([-\d.]+)</text>', page)]
    assert ticks and max(ticks) < 5
    assert seconds_axis(np.array([5.0, 6, 5.5])) == (None, "frame")
    x, label = seconds_axis(np.array([1.7e9, 1.7e9 + 0.5]))
    assert x is not None and x.tolist() == [0, 0.5] and label == "seconds from the start"


def pushed(
    factors: list[float], truth: bool = True, metric: bool = False, seed: int = 0
) -> SequenceEvaluation:
    rng = np.random.default_rng(seed)
    made = SequenceEvaluation(len(factors))
    plane = rng.uniform(1, 4, (24, 32)).astype(np.float32)
    for index, factor in enumerate(factors):
        known = plane if truth else None
        made.push(
            np.full((24, 32, 3), 90, np.uint8),
            plane * np.float32(factor),
            np.ones(plane.shape, bool),
            known,
            stamp=1.7e9 + index / 2,
            latency=0.01,
            metric=metric,
        )
    return made


def test_a_third_variant_is_everywhere() -> None:
    runs = {
        "DyFN": pushed([1, 1.1, 0.9]),
        "base": pushed([1, 2, 0.5]),
        "DyFN + odometry": pushed([1, 1.01, 0.99], metric=True),
    }
    sections = {s.title: s.parts for s in sequence_sections(runs, base="base")}
    lead, figures = sections["At a glance"]
    assert "DyFN + odometry is in metres: AbsRel 0.00" in lead.text  # type: ignore[union-attr]
    beside = figures.figures[0].beside  # type: ignore[union-attr]
    assert [*beside] == ["base", "DyFN + odometry"]
    grid = sections["Frames"][0]
    depths = ["base", "DyFN", "DyFN + odometry"]
    assert grid.columns == [  # type: ignore[union-attr]
        "input",
        "ground truth",
        *depths,
        *(f"error, {name}" for name in depths),
    ]
    assert [*grid.rows] == ["0.00 s", "0.50 s", "1.00 s"]  # type: ignore[union-attr]
    curves = {part.title: part for part in sections["Over time"]}  # type: ignore[union-attr]
    scale = curves["True over predicted depth, one alignment for the sequence (1: no drift)"]
    assert {*runs, "control: ramp"} <= {*scale.lines}  # type: ignore[union-attr]
    assert "Error in metres, no alignment" in curves
    with pytest.raises(ValueError, match="expected one of the runs after the first"):
        sequence_sections(runs, base="DyFN")


def test_without_truth_there_are_no_dashes() -> None:
    runs = {"a": pushed([1, 2], truth=False), "b": pushed([1, 2], truth=False, seed=1)}
    table = score_table({name: run.results() for name, run in runs.items()})
    assert [*table.header] == ["", "p50 ms"]
    assert table.rows == [["a", "10.0"], ["b", "10.0"]]
    assert over_time([Variant("a", "result", {}, {"video_ratio": np.full(3, np.nan)})]) == []
    titles = [s.title for s in sequence_sections(runs, base="b")]
    assert titles == ["At a glance", "Frames", "Latency"]


def test_the_colour_bar_is_of_the_pictures() -> None:
    truth = np.tile(np.geomspace(1, 100, 64), (48, 1))
    one = DepthSnapshot(3, np.zeros((48, 64, 3), np.uint8), truth / 4, truth)
    grid = frame_grid({"new": ShownFrames([one], 4.0), "old": ShownFrames([one], 1.0)})
    bar = grid.bars[0]
    assert bar.label == "depth, m"
    near, far = (float(bar.ticks[share]) for share in (0.0, 1.0))
    assert near == pytest.approx(1.1, abs=0.1) and far == pytest.approx(91, rel=0.05)
    painted = colour_depth(np.array([[near, far]]), near, far)[0].astype(int)
    assert np.abs(bar.colours[[0, -1]] - painted).max() < 12
    shown, (row,) = [*grid.rows], grid.rows.values()
    assert shown == ["3"]
    np.testing.assert_array_equal(row[1], row[2])  # truth and what is right look alike
    assert np.abs(row[1].astype(int) - row[3]).mean() > 20
    assert row[4].mean() < 5 < row[5].mean()
    assert grid_picture(grid).shape == (22 + 50 + 44, 6 * 66, 3)


def test_without_truth_variants_share_a_scale_of_their_own() -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    depths = [np.full((48, 64), value) for value in (1.0, 2.0, 3.0)]
    frames = [DepthSnapshot(i, image, depth, None) for i, depth in enumerate(depths)]
    far = [DepthSnapshot(i, image, depth * 70, None) for i, depth in enumerate(depths)]
    grid = frame_grid({"a": ShownFrames(frames), "b": ShownFrames(far)})
    assert "no unit" in grid.bars[0].label and [*grid.columns] == ["input", "a", "b"]
    rows = [*grid.rows.values()]
    for _, a, b in rows:
        np.testing.assert_array_equal(a, b)
    assert (rows[0][1] != rows[2][1]).any()  # drift is still seen


def test_a_cloud_is_bounded_and_where_it_was() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (100_000, 3))
    points[0] = 1e6
    cloud = PointCloud(points, np.full(points.shape, 90, np.uint8))
    page = cloud_html(CloudView({"a": cloud, "b": cloud}, unit=""))
    found = re.search(r'<script type="application/json">(.*?)</script>', page)
    assert found is not None and len(page) < 700_000
    data = json.loads(found.group(1))
    assert sum(c["count"] for c in data["clouds"]) <= POINTS
    assert 3.5 < data["extent"] < 4.5 and data["grid"] == 0.5 and data["step"] < 2e-4
