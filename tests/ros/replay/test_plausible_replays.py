"""What is implausible in a recording: on stderr, in metrics.json, the report and --strict."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dyfn_core.cli import eval as dyfn_eval
from dyfn_ros.recordings.typestore import CAMERA_INFO, IMAGE, camera_info, image_message
from dyfn_ros.recordings.writer import RecordingWriter
from dyfn_ros.replay.cli import main
from dyfn_ros.replay.jobs import ALL, PARTIAL
from tests.support.rectangles import MATRIX, SIZE, rectangles
from tests.support.tiny_model import load_tiny

COUNT = 8
SECOND = 1_000_000_000
Depth = Callable[[int], np.ndarray | None]


def right(index: int) -> np.ndarray:
    return rectangles(index)[1]


def write(
    path: Path,
    depth: Depth = right,
    *,
    stamp: Callable[[int], int] = lambda i: i * SECOND // 10,
    late: int = 0,
    matrix: np.ndarray = MATRIX,
) -> Path:
    with RecordingWriter(path) as writer:
        for index in range(COUNT):
            at, log = SECOND + stamp(index), SECOND + index * SECOND // 10
            image = image_message(rectangles(index)[0], "rgb8", at, "camera")
            writer.write("/image", IMAGE, image, log)
            info = camera_info(matrix, SIZE, at, "camera")
            writer.write("/camera_info", CAMERA_INFO, info, log)
            truth = depth(index)
            if truth is not None:
                encoding = "16UC1" if truth.dtype == np.uint16 else "32FC1"
                message = image_message(truth, encoding, at + late, "camera")
                writer.write("/depth", IMAGE, message, log)
    return path


def run(recording: Path, *options: str) -> tuple[int, dict[str, Any]]:
    out = recording.with_name("out")
    fixed = ["--out", str(out), "--write", "none", "--model", "tiny", "--threads", "1"]
    code = main([str(recording), *fixed, *options], load_tiny)
    return code, json.loads((out / "metrics.json").read_text())


def test_a_right_recording_is_not_doubted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, metrics = run(write(tmp_path / "bag"), "--strict")
    assert (code, metrics["warnings"], metrics["recording"]["warnings"]) == (ALL, [], {})
    assert "implausible" not in capsys.readouterr().err
    assert "Implausible" not in (tmp_path / "out" / "report.html").read_text()


def test_stamps_of_another_clock_are_named_and_the_option_mends_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = write(tmp_path / "bag", late=SECOND // 5)  # each depth at another image's stamp
    code, metrics = run(recording, "--strict")
    text, other = metrics["warnings"]
    assert code == PARTIAL and text.startswith("/depth: its stamps are 0.2 s after")
    assert other.startswith("the ground truth does not correlate")
    assert capsys.readouterr().err.count(text) == 1
    code, mended = run(recording, "--strict", "--depth-offset", "0.2")
    assert (code, mended["warnings"], mended["options"]["depth_offset"]) == (ALL, [], 0.2)
    _, true = run(write(tmp_path / "true"), "--strict")
    assert mended["image"] == true["image"] != metrics["image"]
    assert true["options"]["depth_offset"] is None


def millimetres(index: int) -> np.ndarray:
    return right(index) * np.float32(1000)


def centimetres(index: int) -> np.ndarray:
    return (right(index) * 10).astype(np.uint16)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"depth": millimetres}, "the true depth is 4000 m"),
        ({"depth": centimetres}, "the true depth is 0.04 m"),
        ({"depth": lambda i: right(0)}, "the ground truth is the same in all 8 frames"),
        ({"depth": lambda i: np.full(SIZE, 2, np.float32)}, "one depth all over"),
        ({"depth": lambda i: right(i)[:, ::-1]}, "does not correlate with any picture"),
        ({"depth": lambda i: right(i) if i < 3 else None}, "3 of 8 frames are scored"),
        ({"matrix": MATRIX * [[20], [20], [1]]}, "cx=950 cy=710 cannot be intrinsics"),
        ({"stamp": lambda i: i * SECOND // 10 % (SECOND // 2)}, "stamps do not rise: 1 of 8"),
    ],
)
def test_each_doubt_is_said_everywhere_once_and_costs_the_exit_code_when_strict(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: dict[str, Any],
    words: str,
) -> None:
    recording = write(tmp_path / "bag", **options)
    code, metrics = run(recording)
    (text,) = metrics["warnings"]
    assert code == ALL and words in text
    assert capsys.readouterr().err.count(f"dyfn-replay: implausible: {text}\n") == 1
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Implausible" in page and words.partition(" of ")[0] in page
    code, again = run(recording, "--strict")
    assert code == PARTIAL and again["warnings"] == [text]


@pytest.mark.parametrize(("depth", "scale"), [(millimetres, "1000"), (centimetres, "10")])
def test_the_option_that_is_named_mends_the_unit(tmp_path: Path, depth: Depth, scale: str) -> None:
    recording = write(tmp_path / "bag", depth)
    (text,) = run(recording)[1]["warnings"]
    assert text.endswith("--depth-scale gives the stored values per metre")
    code, metrics = run(recording, "--strict", "--depth-scale", scale)
    assert (code, metrics["warnings"]) == (ALL, [])
    assert metrics["options"]["depth_scale"] == float(scale)
    _, true = run(write(tmp_path / "true"))
    difference = metrics["alignment"]["scale"] / true["alignment"]["scale"]
    assert difference == pytest.approx(1, abs=0.05)


def test_without_a_topic_of_truth_none_is_missed(tmp_path: Path) -> None:
    recording = write(tmp_path / "bag", lambda i: None)
    code, metrics = run(recording, "--strict")
    assert (code, metrics["warnings"], metrics["image"]) == (ALL, [], None)


def test_a_scored_topic_is_doubted_as_a_model_is(tmp_path: Path) -> None:
    recording = write(tmp_path / "bag", lambda i: right(i)[:, ::-1])
    code, metrics = run(recording, "--prediction-topic", "/depth", "--depth-topic", "none")
    assert (code, metrics["warnings"]) == (ALL, [])
    with RecordingWriter(tmp_path / "both") as writer:
        for index in range(COUNT):
            at = SECOND + index * SECOND // 10
            image, depth = rectangles(index)
            writer.write("/image", IMAGE, image_message(image, "rgb8", at, "camera"), at)
            for topic, values in (("/made", depth), ("/truth", depth[:, ::-1])):
                writer.write(topic, IMAGE, image_message(values, "32FC1", at, "camera"), at)
    options = ["--prediction-topic", "/made", "--depth-topic", "/truth", "--strict"]
    code, metrics = run(tmp_path / "both", *options)
    assert code == PARTIAL and "does not correlate" in metrics["warnings"][0]


def test_a_batch_says_it_of_each_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bags = [str(write(tmp_path / "good")), str(write(tmp_path / "bad", millimetres))]
    fixed = ["--write", "none", "--model", "tiny", "--threads", "1"]
    assert main([*bags, "--out", str(tmp_path / "a"), *fixed], load_tiny) == ALL
    told = capsys.readouterr().err
    assert told.count("bad: implausible: the median of the true depth is 4000 m") == 1
    assert told.count("implausible") == 1
    summary = json.loads((tmp_path / "a" / "summary.json").read_text())
    good, bad = summary["recordings"]
    assert good["warnings"] == "" and "4000 m" in bad["warnings"]
    assert "- bad: the median" in (tmp_path / "a" / "summary.md").read_text()
    code = main([*bags, "--out", str(tmp_path / "b"), *fixed, "--strict"], load_tiny)
    assert code == PARTIAL
    summary = json.loads((tmp_path / "b" / "summary.json").read_text())
    assert [row["code"] for row in summary["recordings"]] == [ALL, PARTIAL]


def test_dyfn_eval_says_it_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("good", "bad"):
        for kind in ("rgb", "depth"):
            (tmp_path / "data" / name / kind).mkdir(parents=True)
        for index in range(COUNT):
            image, depth = rectangles(index)
            depth = depth[:, ::-1] if name == "bad" else depth
            stored = {"rgb": image[..., ::-1], "depth": (depth * 1000).astype(np.uint16)}
            for kind, values in stored.items():
                path = tmp_path / "data" / name / kind / f"{index}.png"
                assert cv2.imwrite(str(path), np.ascontiguousarray(values))
        np.savetxt(tmp_path / "data" / name / "K.txt", MATRIX)
        (tmp_path / "made").mkdir(exist_ok=True)
        np.save(tmp_path / "made" / f"{name}.npy", np.stack([right(i) for i in range(COUNT)]))
    arguments = ["score", "--benchmark", "rgbd", "--data", str(tmp_path / "data")]
    arguments += ["--predictions", str(tmp_path / "made"), "--quantity", "depth"]
    arguments += ["--no-temporal", "--out", str(tmp_path / "out")]
    assert dyfn_eval.main(arguments) == ALL
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    (text,) = results["warnings"]
    assert text.startswith("bad: the ground truth does not correlate with any picture")
    assert capsys.readouterr().err.count("implausible") == 1
    assert "Implausible" in (tmp_path / "out" / "report.html").read_text()
    assert dyfn_eval.main([*arguments, "--strict"]) == PARTIAL
