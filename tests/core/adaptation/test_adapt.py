"""dyfn-train adapt on a made walk along a plane, with a tiny model that has much to learn."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from dyfn_core.adaptation import task as task_module
from dyfn_core.adaptation.config import AdaptConfig
from dyfn_core.adaptation.parts import parts_of
from dyfn_core.adaptation.recording import (
    MOST_SIGMA,
    SparseFrames,
    load_frames,
    reduce_recording,
    save_frames,
)
from dyfn_core.adaptation.scores import PointScorer, at_points, score_frames
from dyfn_core.cli import train as cli
from dyfn_core.data.datasets import open_posed
from dyfn_core.data.frames import DataError
from dyfn_core.data.posed import PosedFrame, PosedRecording
from dyfn_core.models.base import image_to_batch
from dyfn_core.models.checkpoints import load_model, read_checkpoint, save_model
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.mini import MiniModel
from tests.support.textured_plane import CAMERA, SIZE, plane_view, texture, walk
from tests.support.training_toys import tiny_base

WHOLE = texture()
FRAMES = 64  # 6.4 seconds at 10 Hz
QUICK = ["steps=6", "validate_every=3", "length=4", "decoded=3", "threads=1", "ema_decay=0.5"]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk in walk/ (rgb, depth, K.txt, poses.txt), and tiny.safetensors, a model with DyFN."""
    root = tmp_path_factory.mktemp("adapt")
    walked = root / "walk"
    for name in ("rgb", "depth"):
        (walked / name).mkdir(parents=True)
    poses = walk(FRAMES, step=0.02, turn=0.002)
    np.savetxt(walked / "K.txt", CAMERA)
    np.savetxt(walked / "poses.txt", np.stack(poses).reshape(-1, 16))
    for index, pose in enumerate(poses):
        view = plane_view(pose, WHOLE)
        cv2.imwrite(str(walked / "rgb" / f"{index:05d}.png"), view.image)
        depth = np.round(view.depth * 1000).astype(np.uint16)
        cv2.imwrite(str(walked / "depth" / f"{index:05d}.png"), depth)
    model = tiny_base(root)
    with torch.no_grad():
        model.decoder.mask[2].bias.fill_(1.0)  # valid all over
    model.stabilizer = build_dyfn(8, DyFNConfig(hidden=4, pool=2, form="residual"))
    save_model(model, root / "tiny.safetensors")
    return root


@pytest.fixture(scope="module")
def model(place: Path) -> MiniModel:
    loaded = load_model(place / "tiny.safetensors")
    assert isinstance(loaded, MiniModel)
    return loaded.eval()


@pytest.fixture(scope="module")
def frames(place: Path, model: MiniModel) -> SparseFrames:
    (recording,) = open_posed(place / "walk", "auto", {})
    return reduce_recording(recording, model, rate=10.0, told=False)


def test_points_are_where_and_as_far_as_the_plane(frames: SparseFrames, place: Path) -> None:
    assert len(frames) == FRAMES and frames.starts == (0,) and frames.has_truth
    assert not frames.seen[0] and frames.seen[20:].all()
    for index in (20, 50, FRAMES - 1):
        known = torch.isfinite(frames.depth[index])
        view = plane_view(walk(FRAMES, step=0.02, turn=0.002)[index], WHOLE)
        there = at_points(torch.from_numpy(view.depth)[None], frames.place[index][None])[0]
        error = (frames.depth[index][known] / there[known]).log().abs()
        assert float(error.median()) < MOST_SIGMA / 4
        assert (frames.weight[index][known] > 0).all()
        assert not frames.weight[index][~known].any()
        rows, columns = frames.truth.shape[1:]
        size = frames.network_size
        assert (rows, columns) == (size[0] // 2, size[1] // 2)
        assert float(frames.truth[index, rows // 2, columns // 2]) == pytest.approx(
            float(view.depth[SIZE[0] // 2, SIZE[1] // 2]), rel=0.02
        )


def test_latents_are_the_encoders_and_files_hold_everything(
    frames: SparseFrames, place: Path, model: MiniModel, tmp_path: Path
) -> None:
    image = cv2.imread(str(place / "walk" / "rgb" / "00007.png"))[..., ::-1]
    with torch.no_grad():
        wanted = model.encode(image_to_batch(image)[0]).features[0].half()
    assert torch.equal(frames.latent[7], wanted)
    told = replace(frames, problems={"a: b": 3}, starts=(0, 9))
    save_frames(told, tmp_path / "f.safetensors")
    again = load_frames(tmp_path / "f.safetensors")
    for name, value in vars(told).items():
        found = getattr(again, name)
        if isinstance(value, torch.Tensor):
            assert torch.equal(value.nan_to_num(-1), found.nan_to_num(-1)), name
        else:
            assert np.array_equal(value, found), name


def recorded(
    stamps: list[float], poses: list[np.ndarray], told: list[np.ndarray] | None = None
) -> PosedRecording:
    """told: what the odometry says of the poses; None: the truth."""

    def read() -> Iterator[PosedFrame]:
        for stamp, pose, said in zip(stamps, poses, told or poses, strict=True):
            yield PosedFrame(plane_view(pose, WHOLE).image, stamp, CAMERA, said)

    return PosedRecording("made", len(stamps), read)


def test_the_rate_thins_and_a_gap_begins_anew(model: MiniModel) -> None:
    """At 20 Hz every second frame is kept; after a gap of 5 s no track goes on."""
    count = 60
    stamps = [i / 20 + 5.0 * (i >= 30) for i in range(count)]
    found = reduce_recording(recorded(stamps, walk(count, 0.03)), model, rate=10.0, told=False)
    assert found.stamps.tolist() == pytest.approx(stamps[::2])
    assert found.starts == (0, 15)
    assert found.seen[14] and not found.seen[15] and found.seen[25]
    assert not found.has_truth
    assert score_frames(model, found, [20, 25]).truth is None


def test_odometry_that_contradicts_the_pictures_is_refused_with_the_reason(
    model: MiniModel,
) -> None:
    poses = walk(30, 0.03)
    wrong = [poses[0] @ np.linalg.inv(pose) for pose in poses]  # moves the other way
    made = recorded([i / 10 for i in range(30)], poses, wrong)
    with pytest.raises(DataError, match=r"made: \d+ of 30 frames have 16 .*contradicts the pict"):
        reduce_recording(made, model, rate=10.0, told=False)


def test_parts_share_out_the_time(frames: SparseFrames) -> None:
    parts = parts_of(frames, 0.25, 0.25)
    learned = {i for first, last in parts.runs for i in range(first, last + 1)}
    assert parts.test == tuple(range(48, FRAMES))
    assert len(parts.held_back) == 12 and parts.held_back[-1] == 47
    guard = set(range(parts.held_back[0] - 9, parts.held_back[0]))
    assert not learned & {*parts.held_back, *parts.test, *guard} and len(learned) >= 24
    with pytest.raises(DataError, match="4 frames with enough points are held back, expected at"):
        parts_of(frames, 0.05, 0.0)


def test_point_scores_by_hand() -> None:
    depth = np.linspace(1, 4, 32)
    scorer = PointScorer()
    scorer.push(depth * 2, depth, np.ones(32))
    scorer.push(depth, depth, np.ones(32))
    scorer.push(depth[:8], depth[:8], np.ones(8))  # too few
    assert scorer.image() == pytest.approx(0, abs=1e-9)
    best = min(
        np.mean([np.abs(s * k * depth + t - depth) / depth for k in (1, 2)])
        for s in np.linspace(0.3, 1.2, 181)
        for t in np.linspace(0, 1, 101)
    )
    assert best - 0.002 < scorer.video() <= best
    outlier, weight = depth.copy(), np.ones(32)
    outlier[5], weight[5] = 100.0, 1e-9
    scorer = PointScorer()
    scorer.push(outlier, depth, weight)
    assert scorer.image() == pytest.approx(0, abs=1e-6)
    assert np.isnan(PointScorer().video())


def adapt(place: Path, out: Path, *more: str, settings: tuple[str, ...] = ()) -> int:
    """The command; what an earlier run made of the recording is taken over."""
    made, cache = place / "recordings", out.with_suffix(".run") / "recordings"
    if made.exists() and not cache.exists():
        shutil.copytree(made, cache)
    status = run_adapt(place, out, *more, settings=settings)
    if not made.exists():
        shutil.copytree(cache, made)
    return status


def run_adapt(place: Path, out: Path, *more: str, settings: tuple[str, ...] = ()) -> int:
    words = ["adapt", str(place / "walk"), "--model", str(place / "tiny.safetensors")]
    words += ["--out", str(out), *more]
    return cli.main([*words, *(w for s in (*QUICK, *settings) for w in ("--set", s))])


def test_a_model_that_gets_better_is_written_with_a_table(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "mine.safetensors"
    more = ("--decoder", "all", "--test", "0.3", "--hold-back", "0.35")
    settings = ("learning_rate=0.02", "decoder_rate=1")
    assert adapt(place, out, *more, settings=settings) == 0
    printed = capsys.readouterr().out
    for text in ("video AbsRel before", "depth sensor", "held back", "test", str(out)):
        assert text in printed
    rows = (tmp_path / "mine.run" / "table.csv").read_text().splitlines()
    assert [line.split(",")[1:4] for line in rows[1:]] == [
        ["held back", "16", "points"],
        ["held back", "16", "depth sensor"],
        ["test", "19", "points"],
        ["test", "19", "depth sensor"],
    ]
    before, after = (float(value) for value in rows[1].split(",")[6:8])
    assert after < 0.9 * before
    results = json.loads((tmp_path / "mine.run" / "results.json").read_text())
    assert results["best"] == pytest.approx(after) and results["before"] == pytest.approx(before)
    old, new = (read_checkpoint(path).weights for path in (place / "tiny.safetensors", out))
    changed = {name.split(".")[0] for name in old if not torch.equal(old[name], new[name])}
    assert changed == {"decoder", "stabilizer"}
    assert torch.equal(old["decoder.mask.0.weight"], new["decoder.mask.0.weight"])
    assert adapt(place, out, *more, settings=settings) == 1  # the run is there
    assert "already holds a run" in capsys.readouterr().err


def test_a_model_that_does_not_get_better_is_not_written(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At this rate nothing changes; patience ends the run."""
    out = tmp_path / "mine.safetensors"
    settings = ("learning_rate=1e-12", "steps=30", "patience=1")
    assert adapt(place, out, "--hold-back", "0.3", settings=settings) == 1
    assert not out.exists()
    told = capsys.readouterr()
    assert "no model was written" in told.err and "6 steps" in told.err
    assert "held back" in told.out


def test_a_run_that_was_ended_goes_on_to_the_same_model(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ("learning_rate=0.02", "decoder_rate=1")
    more = ("--decoder", "last", "--hold-back", "0.3")
    whole, ended = tmp_path / "whole.safetensors", tmp_path / "ended.safetensors"
    assert adapt(place, whole, *more, settings=settings) == 0
    loss, calls = task_module.AdaptTask.loss, []

    def ending(self: task_module.AdaptTask, batch: task_module.SparseClips):  # type: ignore[no-untyped-def]
        calls.append(batch)
        if len(calls) == 4:
            os.kill(os.getpid(), signal.SIGTERM)
        return loss(self, batch)

    with monkeypatch.context() as patched:
        patched.setattr(task_module.AdaptTask, "loss", ending)
        assert adapt(place, ended, *more, settings=settings) == 143
    assert not ended.exists()
    assert adapt(place, ended, *more, "--resume", settings=settings) == 0
    one, other = (read_checkpoint(path).weights for path in (whole, ended))
    assert all(torch.equal(value, other[name]) for name, value in one.items())


def test_what_cannot_be_adapted_is_said_at_once(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["adapt", str(place / "walk"), "--model", str(place / "base.safetensors")]
    cases = [
        ([*words, "--out", "a.pt"], "expected a file NAME.safetensors"),
        ([*words, "--out", str(tmp_path / "no" / "a.safetensors")], "there is no folder"),
        ([*words, "--out", str(tmp_path / "a.safetensors")], "has no DyFN to adapt"),
        (["adapt", "{root: }", "--out", str(tmp_path / "b.safetensors")], "recording '{root: }'"),
        ([*words, "--out", "c.safetensors", "--set", "lenght=3"], "did you mean 'length'"),
        ([*words, "--out", "d.safetensors", "--set", "decoded=99"], "decoded 99 exceeds length"),
    ]
    for arguments, told in cases:
        assert cli.main(arguments) == 1
        assert told in capsys.readouterr().err


def test_folders_without_poses_and_other_kinds_are_refused(place: Path, tmp_path: Path) -> None:
    (tmp_path / "bare" / "rgb").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "bare" / "rgb" / "0.png"), np.zeros((*SIZE, 3), np.uint8))
    np.savetxt(tmp_path / "bare" / "K.txt", CAMERA)
    with pytest.raises(DataError, match=r"expected poses \(poses.txt"):
        open_posed(tmp_path / "bare", "auto", {})
    with pytest.raises(DataError, match="irs is no recording with poses; expected one of rgbd_fol"):
        open_posed(tmp_path, "irs", {})
    with pytest.raises(DataError, match="rgbd_folder has no option 'tolerence', only"):
        open_posed(place / "walk", "rgbd_folder", {"tolerence": 1})


def test_settings_have_defaults_that_fit_together() -> None:
    assert AdaptConfig(recordings=("a",)).patience is not None
