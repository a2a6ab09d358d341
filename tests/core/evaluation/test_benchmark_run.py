"""dyfn-eval from the command line: scores by value, tables, published numbers, lengths."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from dyfn_core.cli import eval as cli
from dyfn_core.evaluation.benchmarks.long_sequence import length_table, long_sequences
from dyfn_core.evaluation.benchmarks.model_method import ModelMethod, as_array
from dyfn_core.evaluation.benchmarks.pictures import STRIPS, WORST, BenchmarkPictures
from dyfn_core.evaluation.benchmarks.predictions import ArrayMethod
from dyfn_core.evaluation.benchmarks.published import published, published_rows
from dyfn_core.evaluation.benchmarks.registry import (
    BenchmarkSequence,
    BenchmarkSettings,
    open_benchmark,
)
from dyfn_core.evaluation.benchmarks.run import Scoring, evaluate, mean_of
from dyfn_core.evaluation.benchmarks.table import HEADER
from dyfn_core.evaluation.report.html import Table
from dyfn_core.evaluation.report.tables import csv_table, latex_table, markdown_table
from dyfn_core.evaluation.report.worst_frames import WIDTH
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.controls import ema_control, frozen_control, stabilized_by
from dyfn_core.scoring.fits import LEAST_SQUARES
from dyfn_core.scoring.protocols import SequenceScorer, least_squares
from dyfn_core.stream.depth_stream import DepthStream
from tests.support.made_benchmarks import (
    PATCH,
    depth,
    make_scannet,
    make_sintel,
    make_tum,
    make_video,
)

TUM = (24, 32)


def room(root: Path, frames: int = 6) -> Path:
    make_tum(root / "rgbd_dataset_freiburg1_made", frames)
    return root


def read(out: Path) -> dict[str, Any]:
    results: dict[str, Any] = json.loads((out / "results.json").read_text())
    return results


def drifting(i: int) -> np.ndarray:
    """Truth in another unit, scale and shift off, the scale growing by a tenth a frame."""
    return (depth(i, TUM) - 0.5) * (1 + 0.1 * i)


def test_files_are_scored_by_value(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, folder = room(tmp_path / "root"), tmp_path / "mine"
    folder.mkdir()
    np.savez(
        folder / "rgbd_dataset_freiburg1_made.npz",
        depth=np.stack([drifting(i) for i in range(6)]),
    )
    out = tmp_path / "out"
    arguments = ["score", "--benchmark", "tum", "--root", str(root), "--predictions", str(folder)]
    arguments += ["--quantity", "depth", "--out", str(out), "--all-pixels"]
    assert cli.main(arguments) == 0
    scores = read(out)["variants"]["mine"]
    assert scores["image"]["abs_rel"] < 1e-4  # truth is rounded to 0.2 mm
    assert scores["video"]["abs_rel"] > 0.05
    valid = [depth(i, TUM) for i in range(6)]
    for truth in valid:
        truth[PATCH] = np.nan
    metric = [np.nanmean(abs(drifting(i) - t) / t) for i, t in enumerate(valid)]
    assert scores["metric"]["abs_rel"] == pytest.approx(np.mean(metric), rel=1e-3)
    steps = np.diff(np.log([1 + 0.1 * i for i in range(6)]))
    assert scores["spread"]["log_scale_max_step"] == pytest.approx(steps.max(), abs=1e-3)
    scale = read(out)["sequences"][0]["over_time"]["mine"]["scale"]
    ratios = np.divide(scale[1:], scale[:-1])
    assert ratios == pytest.approx([(1 + 0.1 * i) / (1.1 + 0.1 * i) for i in range(5)], rel=1e-3)
    page = (out / "report.html").read_text()
    assert page.count('role="img"') == 3 and "http" not in page
    assert "Over time, rgbd_dataset_freiburg1_made" in page and str(folder) in page
    assert "The scale of mine wanders by" in page
    assert page.count("data:image/jpeg") == 4 * (3 + 6)  # strip, worst frames
    errors = read(out)["sequences"][0]["over_time"]["mine"]["video_abs_rel"]
    worst = int(np.argmax(errors))
    first = page[page.index("<th>worst first") :].split("<tr>")[1]
    assert f"<td>{worst}</td>" in first and f"{errors[worst]:.3f}" in first
    assert f"<td>frame {worst}</td>" in first  # is in the picture
    assert "Latency" not in page  # nothing was run
    printed = capsys.readouterr().out
    for row in ("mine", "control: ramp", "control: constant", "ground truth"):
        assert row in printed


@pytest.mark.parametrize(
    ("quantity", "values", "best"),
    [
        ("inverse", lambda d: 3 / d, "image"),
        ("disparity", lambda d: 3 / d + 0.2, "image"),
        ("disparity", lambda d: 3 / d + 0.2, "video"),
    ],
)
def test_inverse_depth_and_disparity_are_scored_as_such(
    tmp_path: Path, quantity: str, values: Any, best: str
) -> None:
    root, folder = room(tmp_path / "root"), tmp_path / "m" / "rgbd_dataset_freiburg1_made"
    folder.mkdir(parents=True)
    for i in range(6):
        np.save(folder / f"{i}.npy", values(depth(i, TUM)))
    out = tmp_path / "out"
    arguments = ["score", "--benchmark", "tum", "--root", str(root), "--out", str(out)]
    arguments += ["--predictions", str(folder.parent), "--quantity", quantity]
    assert cli.main(arguments) == 0
    scores = read(out)["variants"]["m"]
    assert scores[best]["abs_rel"] < 2e-4
    assert (scores["metric"] is None) == (quantity == "disparity")
    assert cli.main([*arguments[:-1], "depth"]) == 0
    assert read(out)["variants"]["m"][best]["abs_rel"] > 0.01


def test_png_predictions_and_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_sintel(tmp_path / "root", {"ambush_6": 20, "alley_1": 2})
    folder = tmp_path / "pred" / "ambush_6"
    folder.mkdir(parents=True)
    for i in range(20):
        stored = np.round(depth(i, (28, 64)) * 500).astype(np.uint16)
        assert cv2.imwrite(str(folder / f"frame_{i + 1:04}.png"), stored)
    arguments = ["score", "--benchmark", "sintel", "--root", str(tmp_path / "root")]
    arguments += ["--predictions", str(tmp_path / "pred"), "--quantity", "depth"]
    arguments += ["--scale", "500", "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 2
    assert "--allow-missing scores the rest" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert cli.main([*arguments, "--allow-missing"]) == 3
    results = read(tmp_path / "out")
    assert results["variants"]["pred"]["metric"]["abs_rel"] < 1e-3
    assert [s["name"] for s in results["sequences"]] == ["ambush_6"]
    missing = "\n".join(results["missing"])
    assert "alley_1: " in missing and "no predictions of alley_1" in missing
    assert "market_2" in missing
    assert cli.main([*arguments, "--sequences", "ambush_6"]) == 0


def test_a_prediction_of_another_field_of_view_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, folder = room(tmp_path / "root"), tmp_path / "m"
    folder.mkdir()
    np.save(folder / "rgbd_dataset_freiburg1_made.npy", np.ones((6, 24, 40)))
    arguments = ["score", "--benchmark", "tum", "--root", str(root), "--out", str(tmp_path / "o")]
    arguments += ["--predictions", str(folder), "--quantity", "depth"]
    assert cli.main(arguments) == 2
    assert (
        "rgbd_dataset_freiburg1_made, frame 0: ground truth of 32 x 24" in capsys.readouterr().err
    )


def test_a_model_runs_as_its_stream_does(tmp_path: Path, pinhole_with_dyfn: GeometryModel) -> None:
    """The variants share one encoding, and each is byte for byte what DepthStream.push gives."""
    sequence = open_benchmark("tum", room(tmp_path)).sequences[0]
    method = ModelMethod("m", pinhole_with_dyfn, known_camera=True)
    assert method.variants == ("m + DyFN", "m, base", "control: ema", "control: frozen")
    predict = method.open(sequence)
    streams: dict[str, DepthStream] = {}
    for index, frame in enumerate(sequence.frames()):
        if not streams:
            streams = {
                "m + DyFN": DepthStream(pinhole_with_dyfn, frame.camera_matrix),
                "m, base": DepthStream(pinhole_with_dyfn, frame.camera_matrix, stabilize=False),
            }
        found = predict(index, frame)
        for name, stream in streams.items():
            wanted = as_array(stream.push(frame.image, float(index)))
            np.testing.assert_array_equal(found[name], wanted)
    assert not np.array_equal(found["m + DyFN"], found["m, base"])
    assert {name: len(times) for name, times in method.seconds.items()} == dict.fromkeys(
        method.variants, len(sequence)
    )
    assert all(second > 0 for times in method.seconds.values() for second in times)


def test_controls_of_the_latent_are_streams_with_that_stabilizer(
    tmp_path: Path, pinhole_with_dyfn: GeometryModel
) -> None:
    model = pinhole_with_dyfn
    sequence = open_benchmark("tum", room(tmp_path)).sequences[0]
    predict = ModelMethod("m", model).open(sequence)
    found = [predict(i, frame) for i, frame in enumerate(sequence.frames())]
    channels = model.latent_channels
    for name, control in {"ema": ema_control(channels), "frozen": frozen_control(channels)}.items():
        with stabilized_by(model, control):
            stream = DepthStream(model)
            for index, frame in enumerate(sequence.frames()):
                wanted = as_array(stream.push(frame.image, float(index)))
                np.testing.assert_array_equal(found[index][f"control: {name}"], wanted)
    last = [found[-1][name] for name in ("control: ema", "control: frozen", "m, base", "m + DyFN")]
    assert len({array.tobytes() for array in last}) == 4
    plain = ModelMethod("m", model, stabilize=False, controls=False)  # --no-controls
    assert plain.variants == ("m, base",)


def test_the_bundled_model_writes_the_same_files_twice(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    make_video(tmp_path / "bonn", "rgbd_bonn_crowd2", 2)
    arguments = ["run", "--benchmark", "bonn", "--root", str(tmp_path), "--model", "dyfn-mini"]
    arguments += ["--allow-missing", "--no-stabilizer", "--ablations", "--out"]
    texts = []
    for _ in range(2):
        assert cli.main([*arguments, str(tmp_path / "out")]) == 3
        files = sorted((tmp_path / "out").iterdir())
        texts.append({path.name: path.read_text() for path in files})
    pages = [text["report.html"] for text in texts]
    assert pages[0].count("frames a second") == 1
    for text, page in zip(texts, pages, strict=True):  # all but times are the same
        latency = re.compile("<section[^>]*><h2>Latency.*?</section>", re.DOTALL)
        text["report.html"] = latency.sub("", page)
        assert text["report.html"] != page
    assert texts[0] == texts[1]
    assert set(texts[0]) == {"results.json", "report.html"} | {
        f"{stem}.{kind}" for stem in ("table", "sequences") for kind in ("md", "csv", "tex")
    }
    table = texts[0]["table.md"]
    assert "dyfn-mini, base" in table and "+ DyFN |" in table
    assert "dyfn-mini + DyFN" not in table  # --no-stabilizer
    for name in ("control: ema", "control: frozen", "control: ramp", "control: constant"):
        assert f"| {name} |" in table
    (line,) = [line for line in table.splitlines() if line.startswith("| MoGe v1 + DyFN |")]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[1:5] == ["0.028", "0.988", "0.044", "0.984"]
    assert cells[-1].startswith("published")
    assert "without L_align" in table
    results = json.loads(texts[0]["results.json"])
    assert results["layout"] == "depthcrafter" and results["versions"]["numpy"] == np.__version__
    assert results["options"]["model"] == "dyfn-mini"


def test_pictures_are_few_however_many_sequences_and_the_worst_are_the_runs(
    tmp_path: Path,
) -> None:
    opened = open_benchmark("tum", room(tmp_path))
    names = [f"room {n}" for n in range(40)]
    many = replace(opened, sequences=[replace(opened.sequences[0], name=name) for name in names])
    rough = {"room 7": 2, "room 31": 4}  # sequence -> the frame that is off

    def says(sequence: BenchmarkSequence) -> Iterator[np.ndarray]:
        for i in range(6):
            yield depth(i, TUM) * (1.3 if rough.get(sequence.name) == i else 1)

    pictures = BenchmarkPictures(names, "depth", ["m"], ["m"])
    evaluate(many, ArrayMethod("m", "depth", says), Scoring(temporal=False), pictures=pictures)
    assert len(pictures.strips) == STRIPS and {"room 0", "room 39"} <= set(pictures.strips)
    assert len(pictures.worst) == WORST
    found = {(frame.sequence, frame.frame) for frame in pictures.worst[:2]}
    assert found == set(rough.items())
    assert all(frame.shown == frame.frame for frame in pictures.worst[:2])
    assert pictures.worst[1].abs_rel > 0.1 > 0.01 > pictures.worst[2].abs_rel
    numbers = opened.sequences[0].numbers
    assert all(frame.number == numbers[frame.frame] for frame in pictures.worst)
    strip = pictures.strips["room 0"]
    assert [*strip.columns] == ["input", "ground truth", "m", "error, m"]
    assert {picture.shape[1] for row in strip.rows.values() for picture in row} == {WIDTH}


def moving_scale(sequence: BenchmarkSequence) -> Iterator[np.ndarray]:
    return (depth(n, TUM) * (1 + 0.05 * n) for n in sequence.numbers)


def test_error_grows_with_length_and_each_length_is_fitted_anew(tmp_path: Path) -> None:
    opened = open_benchmark("tum", room(tmp_path, 9))
    method = ArrayMethod("drift", "depth", moving_scale)
    results = long_sequences(opened, method, (1, 3, 6, 9, 40))
    assert list(results["lengths"]) == ["1", "3", "6", "9"]  # none has 40 frames
    errors = [results["lengths"][n]["variants"]["drift"]["video"]["abs_rel"] for n in "1369"]
    assert errors[0] < 1e-3 < errors[1] < errors[2] < errors[3]
    for length in (3, 6):
        short = open_benchmark("tum", tmp_path, BenchmarkSettings(frames=length, depth_max=10))
        alone = evaluate(short, method, Scoring(temporal=False))
        found = results["lengths"][str(length)]["variants"]["drift"]
        assert found["video"] == alone["variants"]["drift"]["video"]
    rows = length_table(results).rows
    assert [row[1] for row in rows if row[0] == "drift"] == [1, 3, 6, 9]
    with pytest.raises(ValueError, match="lengths must be positive"):
        long_sequences(opened, method, (0, 3))


def test_long_from_the_command_line(tmp_path: Path) -> None:
    root, folder = room(tmp_path / "root", 9), tmp_path / "drift"
    folder.mkdir()
    sequence = open_benchmark("tum", root).sequences[0]
    np.save(folder / f"{sequence.name}.npy", np.stack(list(moving_scale(sequence))))
    arguments = ["long", "--benchmark", "tum", "--root", str(root), "--lengths", "3", "9"]
    arguments += ["--predictions", str(folder), "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 0
    lines = (tmp_path / "out" / "lengths.csv").read_text().splitlines()
    assert lines[0].startswith("method,frames,sequences,video AbsRel")
    assert [line.split(",")[:3] for line in lines[1:3]] == [
        ["drift", "3", "1"],
        ["control: ramp", "3", "1"],
    ]
    picture = cv2.imread(str(tmp_path / "out" / "lengths.png"))
    assert picture is not None and picture.std() > 5
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Under one alignment for all frames: The scale of drift wanders by" in page
    assert "Error against length" in page and "Implausible" not in page
    assert read(tmp_path / "out")["warnings"] == []


@pytest.mark.parametrize(("more", "scored"), [([], 8), (["--stride", "3"], 3)])
def test_long_takes_the_original_rate(tmp_path: Path, more: list[str], scored: int) -> None:
    make_scannet(tmp_path / "root", "scene0707_00", 8)
    (tmp_path / "p").mkdir()
    np.save(tmp_path / "p/scene0707_00.npy", np.ones((8, 24, 32), np.float32))
    arguments = ["long", "--benchmark", "scannet", "--data", str(tmp_path / "root"), *more]
    arguments += ["--predictions", str(tmp_path / "p"), "--out", str(tmp_path / "out")]
    arguments += ["--lengths", "2", "3", "8", "--allow-missing", "--crop", "0", "0"]
    assert cli.main(arguments) == 3
    found = read(tmp_path / "out")
    assert max(map(int, found["lengths"])) == scored
    assert found["settings"]["stride"] == (3 if more else 1)


def test_long_says_what_is_implausible(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, folder = room(tmp_path / "root", 3), tmp_path / "drift"
    folder.mkdir()
    sequence = open_benchmark("tum", root).sequences[0]
    np.save(folder / f"{sequence.name}.npy", np.stack(list(moving_scale(sequence))))
    for path in root.glob("*/depth/*.png"):
        cv2.imwrite(str(path), np.full(TUM, 5000, np.uint16))
    arguments = ["long", "--benchmark", "tum", "--root", str(root), "--lengths", "3"]
    arguments += ["--predictions", str(folder), "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 0 and cli.main([*arguments, "--strict"]) == 3
    said = "the ground truth is one depth all over, in each of 3 frames"
    assert read(tmp_path / "out")["warnings"] == [f"{sequence.name}: {said}"]
    assert f"implausible: {said}" in capsys.readouterr().err
    assert said in (tmp_path / "out" / "report.html").read_text()


def test_memory_of_long_sequences_does_not_grow(tmp_path: Path) -> None:
    opened = open_benchmark("tum", room(tmp_path, 9))
    sizes: list[int] = []
    keep = SequenceScorer._keep

    def watched(self: SequenceScorer, prediction: np.ndarray, target: np.ndarray) -> None:
        keep(self, prediction, target)
        sizes.append(sum(p.size for p, _ in self._kept))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SequenceScorer, "_keep", watched)
        method = ArrayMethod("drift", "depth", moving_scale)
        long_sequences(opened, method, (9,), Scoring(max_samples=1500))
    assert len(sizes) == 27 and max(sizes) <= 1500  # a frame has 744 samples


def test_crop_cap_and_stride_from_the_command_line(tmp_path: Path) -> None:
    make_scannet(tmp_path / "root", "scene0707_00", 8)
    folder = tmp_path / "m"
    folder.mkdir()
    truth = np.stack([depth(n, (120, 160))[8:-8, 11:-11] for n in (1, 5)])
    np.save(folder / "scene0707_00.npy", truth)
    arguments = ["score", "--benchmark", "scannet", "--root", str(tmp_path / "root")]
    arguments += ["--sequences", "scene0707_00", "--predictions", str(folder)]
    arguments += ["--quantity", "depth", "--first", "1", "--stride", "4", "--frames", "2"]
    arguments += ["--depth-max", "3.5", "--out", str(tmp_path / "out"), "--all-pixels"]
    assert cli.main(arguments) == 0
    results = read(tmp_path / "out")
    assert results["settings"] == {
        "first": 1,
        "stride": 4,
        "frames": 2,
        "depth_max": 3.5,
        "crop": [8, 11],
    }
    scores = results["variants"]["m"]
    assert scores["metric"]["rmse"] < 4e-4  # millimetres, rounded
    assert scores["coverage"] == 1
    steady = scores["temporal"]
    assert steady["tae"] is not None and steady["tae_pairs"] == 1


def test_list_names_every_benchmark(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["list"]) == 0
    printed = capsys.readouterr().out
    for text in ("sintel: Sintel", "cap 70 m", "crop 8 px above and below, 11 left and right"):
        assert text in printed
    assert "at most 110 frames, from frame 30" in printed and "rgbd: RGB-D folder" in printed


def test_least_squares_by_option() -> None:
    rng = np.random.default_rng(1)
    truth = rng.uniform(1, 5, (20, 20))
    prediction = truth * 0.5 + rng.normal(0, 0.2, truth.shape)
    prediction[0, :5] = 9  # outliers, which least squares follows
    design = np.stack([prediction.ravel(), np.ones(400)], 1)
    wanted = np.linalg.lstsq(design, truth.ravel(), rcond=None)[0]
    assert least_squares(prediction, truth) == pytest.approx(tuple(wanted))
    score = SequenceScorer(fit=LEAST_SQUARES).push(prediction, truth)
    assert (score.scale, score.shift) == pytest.approx(tuple(wanted), rel=1e-5)
    robust = SequenceScorer().push(prediction, truth)
    assert score.metrics is not None and robust.metrics is not None
    assert robust.metrics["abs_rel"] < score.metrics["abs_rel"]
    assert least_squares(np.full(4, 2.0), np.array([1.0, 2, 3, 6])) == (1.0, 1.0)
    with pytest.raises(ValueError, match="fit 'best' is unknown"):
        SequenceScorer(fit="best")


def test_published_numbers() -> None:
    rows = published()
    assert len({(r.part, r.method, r.benchmark, r.protocol) for r in rows}) == len(rows) == 104
    sintel = published_rows("sintel")
    assert (sintel["DepthCrafter"]["video"].abs_rel, sintel["DepthCrafter"]["video"].delta1) == (
        0.270,
        0.697,
    )
    scannet = published_rows("scannet")
    assert scannet["VGGT"]["video"].note == "trained on this set"
    assert "video" not in scannet["DepthPro"] and scannet["DepthPro"]["metric"].abs_rel == 0.088
    assert published_rows("kitti", "ablations")["MoGe v1 + DyFN, GRU"]["video"].delta1 == 0.968
    assert published_rows("tum") == {}
    assert all(0 < r.abs_rel < 1 and 0 < r.delta1 < 1 for r in rows)


def test_tables_in_three_languages() -> None:
    table = Table(("a_b", "50%"), [["x & y|z", 0.12345], ["none", None]])
    assert markdown_table(table).splitlines()[2:] == [r"| x & y\|z | 0.123 |", "| none | – |"]
    assert csv_table(table) == "a_b,50%\nx & y|z,0.12345\nnone,\n"
    latex = latex_table(table, "50% of it")
    assert r"a\_b & 50\% \\" in latex and r"x \& y|z & 0.123 \\" in latex
    assert r"\caption{50\% of it}" in latex and r"none & -- \\" in latex


def test_means_leave_out_what_is_not_there() -> None:
    trees = [{"a": 1.0, "n": 2, "deep": {"x": None}}, {"a": 2.0, "n": 3, "deep": {"x": 4.0}}, None]
    assert mean_of(trees) == {"a": 1.5, "n": 5, "deep": {"x": 4.0}}
    assert mean_of([None, None]) is None
    assert len(HEADER) == len(set(HEADER))
