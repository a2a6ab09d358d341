"""Pictures and the report: what the colours mean, and that the page stands alone."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from dyfn_core.evaluation.report.colours import (
    INVALID,
    colour_depth,
    colour_error,
    depth_range,
)
from dyfn_core.evaluation.report.frame_grid import BAR, FrameStrip
from dyfn_core.evaluation.report.html import (
    ReportPicture,
    Section,
    Table,
    Text,
    format_cell,
    text_table,
    write_report,
)
from dyfn_core.evaluation.report.pictures import curves, draw_cloud, encode_picture


def test_near_is_red_far_is_blue_and_invalid_is_grey() -> None:
    near, far, *invalid = colour_depth(np.array([[1.0, 10, np.nan, np.inf, 0, -1]]), 1, 10)[0]
    assert near[0] > near[2] + 50
    assert far[2] > far[0]
    assert all(tuple(pixel) == INVALID for pixel in invalid)


def test_error_is_relative_black_when_right_and_grey_without_truth() -> None:
    prediction = np.array([[2.0, 2.0, 4.0, np.nan, 1.0]])
    target = np.array([[2.0, 1.9, 2.0, 2.0, np.nan]])
    right, small, large, *unknown = colour_error(prediction, target)[0].astype(int)
    assert right.sum() < 20
    assert right.sum() < small.sum() < large.sum()
    assert all(tuple(pixel) == INVALID for pixel in unknown)


def test_depth_range_survives_empty_and_flat_depth() -> None:
    assert depth_range([np.full((2, 2), np.nan)]) == (1, 1.05)
    near, far = depth_range([np.full((2, 2), 3.0), np.full((2, 2), np.nan)])
    assert near == 3 and far > 3


@pytest.mark.parametrize(("expected", "kept"), [(100, 6), (3, 3), (1, 1), (0, 0)])
def test_the_strip_keeps_evenly_spaced_frames(expected: int, kept: int) -> None:
    strip = FrameStrip(expected)
    for index in range(expected):
        strip.add(index, np.zeros((6, 8, 3), np.uint8), np.ones((6, 8)), np.ones((6, 8)))
    assert len(strip.snapshots) == kept
    if expected == 100:
        assert [s.index for s in strip.snapshots] == [0, 20, 40, 59, 79, 99]
    if kept == 0:
        with pytest.raises(ValueError, match="no frame was kept"):
            strip.draw()


def test_the_strip_shows_the_aligned_prediction_beside_the_truth() -> None:
    truth = np.tile(np.linspace(1, 5, 80), (60, 1))
    strip = FrameStrip(1, width=80)
    strip.add(0, np.zeros((60, 80, 3), np.uint8), truth / 4, truth)
    right, wrong = strip.draw(4, 0).astype(int), strip.draw(1, 0).astype(int)
    columns = [slice(82 * i + 1, 82 * i + 81) for i in range(4)]
    rows = slice(-61 - BAR, -1 - BAR)
    assert right.shape[1] == 4 * 82
    assert np.abs(right[rows, columns[1]] - right[rows, columns[2]]).mean() < 1
    assert np.abs(wrong[rows, columns[1]] - wrong[rows, columns[2]]).mean() > 30
    assert right[rows, columns[3]].mean() < 5 < wrong[rows, columns[3]].mean()


def test_the_strip_without_truth_has_two_columns() -> None:
    strip = FrameStrip(1, width=80)
    strip.add(0, np.zeros((60, 80, 3), np.uint8), np.ones((60, 80)), None)
    assert strip.draw().shape[1] == 2 * 82


def test_a_cloud_is_seen_in_its_colours_with_the_near_point_in_front() -> None:
    across = np.linspace(-1, 1, 300)
    wall = np.stack([*np.meshgrid(across, across), np.full((300, 300), 3.0)], -1)
    red = np.tile(np.array([200, 0, 0], np.uint8), (300, 300, 1))
    blue = red[..., ::-1]
    picture = draw_cloud(wall, red)
    assert (picture == [200, 0, 0]).all(-1).mean() > 0.05
    assert (picture == 255).all(-1).mean() > 0.2
    for order in (1, -1):
        points = np.stack([wall, wall * 1.5][::order])
        both = draw_cloud(points, np.stack([red, blue][::order]))
        assert (both[165:195, 225:255] == [200, 0, 0]).all()
    assert (draw_cloud(wall * np.nan, red) == 255).all()


def test_curves_draw_every_panel_and_bear_gaps() -> None:
    one = curves({"a": {"x": [1, None, 3]}})
    two = curves({"a": {"x": [1, None, 3]}, "b": {"x": [1, 2, 3], "y": [None, None, None]}})
    assert two.shape[0] == 2 * one.shape[0]
    assert one.std() > 5


def test_pictures_are_encoded_in_the_right_channel_order() -> None:
    image = np.zeros((4, 4, 3), np.uint8)
    image[..., 0] = 200
    decoded = cv2.imdecode(np.frombuffer(encode_picture(image), np.uint8), cv2.IMREAD_COLOR)
    assert decoded[0, 0].tolist() == [0, 0, 200]


def test_the_report_is_one_file_that_escapes_its_text(tmp_path: Path) -> None:
    parts = [
        Text("a < b", note=True),
        Table(("name", "x"), [["<b>", 0.12345], ["none", None]]),
        ReportPicture(np.zeros((4, 4, 3), np.uint8), 'black "square"'),
        ReportPicture(np.zeros((4, 4, 3), np.uint8), "curve", photographic=False),
    ]
    write_report(tmp_path / "report.html", "Title & more", [Section("S", parts)])
    page = (tmp_path / "report.html").read_text()
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert "<title>Title &amp; more</title>" in page
    assert "a &lt; b" in page and "&lt;b&gt;" in page and "0.123" in page and "–" in page
    assert "data:image/jpeg;base64," in page and "data:image/png;base64," in page
    assert "black &quot;square&quot;" in page
    assert 'src="http' not in page and "<script" not in page  # nothing to point at, no script


def test_tables_for_the_terminal_are_aligned() -> None:
    lines = text_table(Table(("", "AbsRel"), [["long name", 0.1], ["x", None]])).split("\n")
    assert lines == ["           AbsRel", "long name   0.100", "x               –"]
    assert format_cell(3) == "3"
