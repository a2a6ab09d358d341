"""Many recordings through dyfn-replay: expanded, isolated, resumed and summed up."""

import csv
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording
from dyfn_ros.replay import batch
from dyfn_ros.replay.batch import expand, is_many, plan, run_locally
from dyfn_ros.replay.batch_summary import mean_of
from dyfn_ros.replay.cli import main
from dyfn_ros.replay.jobs import ALL, CRASHED, PARTIAL, UNUSABLE, Outcome, outcome_of
from dyfn_ros.replay.run import replay
from dyfn_ros.replay.settings import Outputs, PredictionTopic, ReplayJob, Run, Source, TopicChoice
from tests.support.tiny_model import load_tiny

CAMERA = np.array([[40.0, 0, 23.5], [0, 40.0, 17.5], [0, 0, 1]])


def record(path: Path, seed: int = 0, frames: int = 2) -> Path:
    rng = np.random.default_rng(seed)
    made = []
    for index in range(frames):
        image = cv2.resize(rng.integers(0, 255, (5, 6, 3), np.uint8), (48, 36))
        depth = cv2.resize(rng.uniform(1, 4, (4, 5)), (48, 36))
        made.append(FrameToRecord(image, depth, CAMERA, None, 50 + index / 15))
    write_rgbd_recording(path, made)
    return path


@pytest.fixture
def walks(tmp_path: Path) -> Path:
    folder = tmp_path / "walks"
    for seed, name in enumerate(("a", "b.mcap", "c")):
        record(folder / name, seed)
    return folder


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Workers in this process; the list takes the names of what was run."""
    ran: list[str] = []

    def run(jobs, loader, workers):  # type: ignore[no-untyped-def]
        for job in jobs:
            ran.append(job.name)
            yield job, outcome_of(job.job, loader)

    monkeypatch.setattr(batch, "run_locally", run)
    return ran


def job_of(recording: Path, out: Path) -> ReplayJob:
    return ReplayJob(Source(recording), Run(model="tiny"), Outputs(out, write=()))


def run(out: Path, *arguments: object) -> int:
    common = ["--out", str(out), "--model", "tiny", "--write", "none"]
    return main([*map(str, arguments), *common], load_tiny)


def test_a_folder_stands_for_what_is_in_it(walks: Path, tmp_path: Path) -> None:
    assert [p.name for p in expand([walks])] == ["a", "b.mcap", "c"]
    assert is_many([walks]) and is_many([walks / "a", walks / "c"])
    assert not is_many([walks / "a"]) and not is_many([walks / "b.mcap"])
    assert not is_many([tmp_path / "nowhere"])


def test_parts_of_one_recording_stay_one(tmp_path: Path) -> None:
    for name in ("walk_0.mcap", "walk_1.mcap", "walk_10.mcap"):
        (tmp_path / name).touch()
    assert expand([tmp_path]) == [tmp_path]
    (tmp_path / "other.bag").touch()
    assert len(expand([tmp_path])) == 4


def test_a_list_names_recordings_beside_it(walks: Path) -> None:
    (walks / "list.txt").write_text("# two\nc  # the last\n\n../walks/a\nc\n")
    assert [p.name for p in expand([walks / "list.txt"])] == ["c", "a"]
    (walks / "empty.txt").write_text("# none\n")
    with pytest.raises(RecordingError, match=r"empty\.txt: expected a recording a line"):
        expand([walks / "empty.txt"])
    with pytest.raises(RecordingError, match=r"no\.txt"):
        expand([walks / "no.txt"])


def test_hidden_companions_in_a_folder_are_no_recordings(walks: Path) -> None:
    for companion in ("._a.mcap", "__MACOSX/._b.mcap", ".cache/x.db3"):
        (walks / companion).parent.mkdir(exist_ok=True)
        (walks / companion).write_bytes(b"\0\5\x16\7")
    assert [p.name for p in expand([walks])] == ["a", "b.mcap", "c"]


def test_equal_names_get_folders_of_their_own(tmp_path: Path) -> None:
    paths = [tmp_path / one / "walk.mcap" for one in ("x", "y", "x")]
    jobs = plan(paths, job_of(tmp_path, tmp_path / "out"), TopicChoice(), "sum")
    assert [job.name for job in jobs] == ["walk", "y_walk", "x_walk"]
    assert len({job.job.outputs.folder for job in jobs}) == 3


def test_the_key_is_of_options_model_and_files(walks: Path, tmp_path: Path) -> None:
    usual = job_of(walks, tmp_path / "out")

    def key(fingerprint: str = "sum", **changed: object) -> str:
        job = replace(usual, **changed)  # type: ignore[arg-type]
        return plan([walks / "b.mcap"], job, TopicChoice(), fingerprint)[0].key

    first = key()
    moved = Outputs(tmp_path / "elsewhere", write=(), progress=False)
    assert first == key() == key(outputs=moved)
    others = [
        key("other"),
        key(source=Source(walks, stride=2)),
        key(run=Run(model="tiny", controls=True)),
        key(run=PredictionTopic("/depth")),
        key(outputs=Outputs(tmp_path / "out")),
    ]
    assert len({first, *others}) == 6
    os.utime(walks / "b.mcap", ns=(1, 1))
    assert key() != first


def test_one_that_fails_is_reported_and_the_others_finish(
    walks: Path, tmp_path: Path, here: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (walks / "broken.mcap").write_bytes(b"nothing of the kind")
    assert run(tmp_path / "out", walks) == PARTIAL
    assert here == ["a", "b", "broken", "c"]
    told = capsys.readouterr()
    assert "broken.mcap: failed (code 2)" in told.err
    assert "| broken | failed |" in told.out
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [row["code"] for row in summary["recordings"]] == [0, 0, 2, 0]
    assert "broken.mcap" in summary["recordings"][2]["reason"]
    scores = []
    for name in ("a", "b", "c"):
        found = json.loads((tmp_path / "out" / name / "metrics.json").read_text())
        scores.append(found["video"]["abs_rel"])
    mean = summary["means"]["video_abs_rel"]
    assert mean["mean"] == pytest.approx(np.mean(scores))
    assert min(scores) <= mean["low"] < mean["mean"] < mean["high"] <= max(scores)
    assert mean["recordings"] == 3
    with (tmp_path / "out" / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["state"] for row in rows] == ["ok", "ok", "failed", "ok"]
    assert float(rows[1]["video_abs_rel"]) == pytest.approx(scores[1])
    assert (tmp_path / "out" / "summary.md").read_text() in told.out


def test_finished_ones_are_not_run_again(walks: Path, tmp_path: Path, here: list[str]) -> None:
    (walks / "broken.mcap").write_bytes(b"nothing of the kind")
    run(tmp_path / "out", walks)
    first = (tmp_path / "out" / "summary.json").read_text()
    here.clear()
    assert run(tmp_path / "out", walks) == PARTIAL
    assert here == ["broken"]
    assert (tmp_path / "out" / "summary.json").read_text() == first
    (tmp_path / "out" / "a" / "metrics.json").unlink()
    (tmp_path / "out" / "c" / "outcome.json").write_text("{")
    here.clear()
    run(tmp_path / "out", walks)
    assert here == ["a", "broken", "c"]
    here.clear()
    run(tmp_path / "out", walks, "--stride", "2")
    assert len(here) == 4


def test_exit_codes_say_all_or_none(walks: Path, tmp_path: Path, here: list[str]) -> None:
    assert run(tmp_path / "out", walks) == ALL
    assert run(tmp_path / "none", tmp_path / "x.mcap", tmp_path / "y.mcap") == UNUSABLE
    assert not (tmp_path / "none" / "x" / "metrics.json").exists()
    assert (tmp_path / "none" / "summary.json").exists()


def test_a_wrong_model_is_named_once(
    walks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["--out", str(tmp_path / "out"), "--model", "huge"]
    assert main([str(walks), *common], load_tiny) == UNUSABLE
    assert capsys.readouterr().err.count("'huge'") == 1
    assert not (tmp_path / "out").exists()


def dying_loader(name: str, device: str):  # type: ignore[no-untyped-def]
    """Kills the first worker that loads it after the mark was set."""
    try:
        (Path.cwd() / "die").unlink()
    except FileNotFoundError:
        return load_tiny(name, device)
    os.kill(os.getpid(), 9)
    raise AssertionError("a killed process goes on")


def test_a_worker_that_dies_takes_no_other_along(
    walks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "die").touch()
    job = job_of(walks, tmp_path / "out")
    jobs = plan([walks / "a", walks / "c"], job, TopicChoice(), "sum")
    found = {outcome.code: (job, outcome) for job, outcome in run_locally(jobs, dying_loader, 2)}
    assert found[CRASHED][1] == Outcome(CRASHED, "its process ended with code -9")
    survivor = found[ALL][0].job
    other = json.loads((survivor.outputs.folder / "metrics.json").read_text())
    assert other["output_sha256"] == alone(survivor.source.recording, tmp_path)["output_sha256"]


def alone(recording: Path, folder: Path) -> dict[str, Any]:
    """metrics.json of a replay outside of any batch."""
    outputs = Outputs(folder / "alone", write=())
    return replay(Source(recording), Run(model="tiny"), outputs, load_tiny)


def test_ray_does_the_same(
    walks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("ray", reason="the extra `ray` is not installed")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_DISABLE_IMPORT_WARNING", "1")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    (walks / "broken.mcap").write_bytes(b"nothing of the kind")
    chosen = [walks / "a", walks / "broken.mcap"]
    assert run(tmp_path / "out", *chosen, "--ray", "local") == PARTIAL
    assert "broken.mcap: failed (code 2)" in capsys.readouterr().err
    found = json.loads((tmp_path / "out" / "a" / "metrics.json").read_text())
    assert found["output_sha256"] == alone(walks / "a", tmp_path)["output_sha256"]


def test_ray_that_is_missing_is_named(
    walks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    assert run(tmp_path / "out", walks, "--ray", "local") == UNUSABLE
    assert "ray is not installed: pip install 'dyfn_ros[ray]'" in capsys.readouterr().err


def test_the_interval_is_seeded_and_covers_the_mean() -> None:
    values = np.random.default_rng(1).normal(0.2, 0.05, 40)
    found = mean_of(values)
    assert found == mean_of(values)
    assert found.low is not None and found.high is not None
    half = 1.96 * values.std(ddof=1) / np.sqrt(40)
    assert found.high - found.low == pytest.approx(2 * half, rel=0.1)
    assert mean_of([0.3]).low is None
