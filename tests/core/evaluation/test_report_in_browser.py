"""The report as a browser shows it: it fits narrow windows, and its cloud can be turned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dyfn_core.cli import eval as cli
from dyfn_core.evaluation.report.cloud_view import CloudView, PointCloud
from dyfn_core.evaluation.report.html import Section, Table, write_report
from dyfn_core.evaluation.report.sequence import sequence_sections
from dyfn_core.evaluation.sequence import SequenceEvaluation
from dyfn_core.geometry.registration import Similarity
from tests.support.browser import FITS, assert_fits, look
from tests.support.made_benchmarks import depth, make_tum

pytestmark = pytest.mark.slow

WIDTHS = (1280, 500)
SEEN = (
    FITS
    + """
  var canvas = document.querySelector("canvas"), gl = canvas.getContext("webgl");
  var box = document.querySelector("input");
  function share() {
    box.dispatchEvent(new window.Event("change"));  // draws, and the drawing is read at once
    var size = canvas.width * canvas.height, pixels = new Uint8Array(4 * size), red = 0, blue = 0;
    gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    for (var i = 0; i < size; i++) {
      if (pixels[4 * i] > 180 && pixels[4 * i + 1] < 60) red += 1;
      if (pixels[4 * i + 2] > 180 && pixels[4 * i + 1] < 60) blue += 1;
    }
    return [red / size, blue / size];
  }
  var first = share();
  canvas.dispatchEvent(new window.KeyboardEvent("keydown", { key: "ArrowUp" }));
  for (var i = 0; i < 12; i++)
    canvas.dispatchEvent(new window.KeyboardEvent("keydown", { key: "ArrowLeft" }));
  var turned = share();
  document.querySelectorAll("button")[1].click();
  return { first: first, turned: turned, other: share(), fit: fit,
    drawn: document.querySelector(".cloud").classList.contains("live") };
"""
)


def drifting(count: int, drift: float) -> SequenceEvaluation:
    made = SequenceEvaluation(count)
    plane = np.tile(np.linspace(1, 4, 32, dtype=np.float32), (24, 1))
    image = np.full((24, 32, 3), 90, np.uint8)
    for index in range(count):
        depth = plane * np.float32(np.exp(drift * np.sin(index)))
        made.push(image, depth, depth > 0, plane, stamp=1.7e9 + index / 10, latency=0.02)
    return made


def wall(colour: tuple[int, int, int]) -> PointCloud:
    """A square of 2 m, seen face on by a camera that looks along y."""
    across = np.stack(np.meshgrid(np.linspace(-1, 1, 80), np.linspace(0, 2, 80)), -1).reshape(-1, 2)
    points = np.stack([across[:, 0], np.full(len(across), 3.0), across[:, 1]], axis=1)
    return PointCloud(points, np.tile(np.array(colour, np.uint8), (len(points), 1)))


def test_a_report_fits_and_its_cloud_turns(tmp_path: Path) -> None:
    runs = {
        "a model with a long name, with DyFN": drifting(12, 0.1),
        "a model with a long name, base": drifting(12, 0.3),
    }
    forward = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    poses = [Similarity(forward, np.array([0, 0.1 * i, 1.0])) for i in range(5)]
    clouds = {"red": wall((230, 20, 20)), "blue": wall((20, 20, 230))}
    sections = sequence_sections(
        runs, base=[*runs][1], cloud=CloudView(clouds, poses, "m", "two walls")
    )
    many = Table(("method", *(f"score {n}" for n in range(18))), [["name", *[0.123] * 18]])
    few = Table(("", *(f"video AbsRel {n}" for n in range(6))), [["a longer name", *[0.1] * 6]])
    facts = Table(("", ""), [["output", "a/" * 80], ["hash", "0" * 64]])
    write_report(tmp_path / "r.html", "t", [*sections, Section("More", [many, few, facts])])
    assert (tmp_path / "r.html").stat().st_size < 700_000
    shown = look(tmp_path / "r.html", WIDTHS, SEEN, tmp_path)
    assert_fits({width: seen.get("fit", seen) for width, seen in shown.items()})
    for seen in shown.values():
        assert seen["drawn"]
        (red, blue), (turned, _), (gone, other) = seen["first"], seen["turned"], seen["other"]
        assert red > 0.05 and blue == 0
        assert turned < 0.7 * red  # from the side the wall is narrow
        assert gone == 0 and other == pytest.approx(turned, rel=0.05)


@pytest.mark.parametrize(("command", "more"), [("score", []), ("long", ["--lengths", "3", "8"])])
def test_reports_of_dyfn_eval_fit(tmp_path: Path, command: str, more: list[str]) -> None:
    sequence = "rgbd_dataset_freiburg1_made"
    make_tum(tmp_path / "root" / sequence, 8)
    predictions = tmp_path / "a method with a long name"
    predictions.mkdir()
    drifting = [depth(i, (24, 32)) * (1 + 0.1 * i) for i in range(8)]
    np.save(predictions / f"{sequence}.npy", np.stack(drifting))
    arguments = [command, "--benchmark", "tum", "--root", str(tmp_path / "root"), *more]
    arguments += ["--predictions", str(predictions), "--quantity", "depth"]
    assert cli.main([*arguments, "--out", str(tmp_path / "out")]) == 0
    page = tmp_path / "out" / "report.html"
    assert_fits(look(page, WIDTHS, f"{FITS} return fit;", tmp_path))
