"""Training DyFN: what has gradients, the latent cache, precision, and curves of a run."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

from dyfn_core.cli.train import main
from dyfn_core.data.clips import draw_batch, find_sequences
from dyfn_core.training.config import (
    BaseRunConfig,
    ConfigError,
    read_config,
)
from dyfn_core.training.dyfn_config import DyFNRunConfig
from dyfn_core.training.loop.checkpoint import read_state
from dyfn_core.training.loop.run_folder import read_log
from dyfn_core.training.scaling_curve import images_at, last_doubling
from dyfn_core.training.tasks.dyfn_unrolled import UnrolledTask
from dyfn_core.training.tasks.latent_cache import encode_clips
from tests.support.made_frames import write_shard
from tests.support.seeded import redraw
from tests.support.training_toys import (
    PATIENCE,
    environment,
    tiny_base,
    tiny_dyfn_settings,
    wait_for_step,
)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """base.safetensors, data/ and config.yaml."""
    folder = tmp_path_factory.mktemp("dyfn")
    tiny_base(folder)
    settings = tiny_dyfn_settings(folder) | {"log_every": 1}
    settings["method"] |= {"length": 4, "objective": {"kind": "terms", "decoded": 4}}
    (folder / "config.yaml").write_text(yaml.safe_dump(settings))
    return folder


def settings(place: Path, *overrides: str) -> DyFNRunConfig:
    return read_config(place / "config.yaml", DyFNRunConfig, list(overrides))


@pytest.fixture
def task(place: Path) -> UnrolledTask:
    """With heads that do something, so that the gradient reaches every parameter."""
    task = UnrolledTask(settings(place), place / "latents")
    made = task.model.stabilizer
    assert made is not None
    redraw((made.gamma_head.weight, made.beta_head.weight), 0.1, seed=5)  # type: ignore[union-attr]
    return task


def gradients(task: UnrolledTask, batch: object) -> torch.Tensor:
    """DyFN's gradient as one vector."""
    task.model.zero_grad(set_to_none=True)
    torch.manual_seed(11)
    task.loss(batch)[0].backward()  # type: ignore[arg-type]
    assert task.model.stabilizer is not None
    return torch.cat([p.grad.flatten() for p in task.model.stabilizer.parameters()])  # type: ignore[union-attr]


def test_only_dyfn_has_gradients(task: UnrolledTask) -> None:
    gradients(task, next(task.batches(0)))
    for name, parameter in task.model.named_parameters():
        assert (parameter.grad is not None) == name.startswith("stabilizer.")
        assert parameter.grad is None or float(parameter.grad.abs().sum()) > 0
    trained = {id(p) for group in task.groups() for p in group["params"]}
    assert trained == {id(p) for p in task.model.parameters() if p.requires_grad}


def test_gradients_agree_with_those_without_a_cache(task: UnrolledTask) -> None:
    assert task.cache is not None
    cached = task.cache.entries[0]
    images = draw_batch(task.source, find_sequences(task.source, "train"), 0)
    fresh = encode_clips(task.model, images)
    assert torch.equal(cached.latent, fresh.latent)
    ours = gradients(task, cached)
    assert float(ours.norm()) > 1e-4
    assert torch.equal(ours, gradients(task, fresh))
    # The cache rounds latents to float16: this is all that it changes.
    with torch.no_grad():
        clips = [task.model.encode(clip.float() / 255).features for clip in images.image]
    exact = torch.stack(clips)
    assert not torch.equal(exact, fresh.latent.float())
    assert torch.equal(exact.half(), fresh.latent)
    unrounded = gradients(task, replace(fresh, latent=exact))
    assert torch.cosine_similarity(ours, unrounded, dim=0) > 0.99


def test_run_without_a_cache_encodes_clips_of_its_own(place: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    config = [str(place / "config.yaml"), "--out", str(out), "--set", "method.cache_draws=0"]
    assert main(["dyfn", *config]) == 0
    lines = [line for line in read_log(out / "log.jsonl") if line["group"] == "train"]
    assert [line["images"] for line in lines] == [4, 8]
    assert not (out / "latents").exists()


@pytest.mark.slow
def test_signal_to_the_whole_process_group_leaves_a_checkpoint(place: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    config = [str(place / "config.yaml"), "--out", str(out)]
    sets = [
        "method.cache_draws=0",
        "steps=1000000",
        "checkpoint_minutes=1000",
        "validate_every=10000000",
    ]
    command = [sys.executable, "-m", "dyfn_core.cli.train", "dyfn", *config]
    command += [word for setting in sets for word in ("--set", setting)]
    process = subprocess.Popen(
        command, env=environment(), stderr=subprocess.PIPE, start_new_session=True
    )
    wait_for_step(process, out, 2)
    os.killpg(process.pid, signal.SIGINT)
    _, complaint = process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + signal.SIGINT
    assert b"SIGINT: checkpoint written at step" in complaint
    assert read_state(out)["step"] == read_log(out / "log.jsonl")[-1]["step"]


def test_losses_are_float32_under_mixed_precision(task: UnrolledTask) -> None:
    batch = next(task.batches(0))
    seen = []
    terms = task._terms

    def watched(affine, target, frames):  # type: ignore[no-untyped-def]
        seen.append((affine.points.dtype, torch.is_autocast_enabled("cpu")))
        return terms(affine, target, frames)

    task._terms = watched  # type: ignore[method-assign]
    torch.manual_seed(11)
    exact = float(task.loss(batch)[0])
    torch.manual_seed(11)
    with torch.autocast("cpu", torch.bfloat16):
        loss = task.loss(batch)[0]
    loss.backward()
    assert seen == [(torch.float32, False)] * 2
    assert loss.dtype == torch.float32
    assert float(loss) != exact
    assert float(loss) == pytest.approx(exact, rel=0.05)
    assert task.model.stabilizer is not None
    assert all(p.grad.isfinite().all() for p in task.model.stabilizer.parameters())  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("dyfn.hiden=3", "unknown key 'hiden', did you mean 'hidden'"),
        ("dyfn.hidden=many", "hidden: .*integer"),
        ("dyfn.form=papre", "form 'papre' is unknown, expected one of"),
        ("hidden=3", "unknown key 'hidden'"),
        ("stages=[{from_step: 0, bacth: 1, sizes: [[32, 64]]}]", "did you mean 'stages.0.batch'"),
        ("from_step=3", "unknown key 'from_step', did you mean 'stages.from_step'"),
        ("mixed_precision=bf61", "mixed_precision"),
    ],
)
def test_bad_nested_settings_are_named(place: Path, override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        settings(place, override)


def test_bad_model_settings_are_named(place: Path, tmp_path: Path) -> None:
    values = {"data": ["x"], "steps": 1, "model": {"latent_chanels": 4}}
    values["stages"] = [{"from_step": 0, "batch": 1, "sizes": [[32, 64]]}]
    (tmp_path / "base.yaml").write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match=r"model: .*did you mean 'latent_channels'"):
        read_config(tmp_path / "base.yaml", BaseRunConfig, [])


def write_log(run: Path, with_images: bool) -> None:
    run.mkdir()
    lines = []
    for step, error in ((2, 0.4), (4, 0.3), (8, 0.25)):
        images = {"images": 4 * step} if with_images else {}
        lines.append({"step": step, "group": "train", "loss": 1.0, **images})
        lines.append({"step": step, "group": "validation", "clips_abs_rel": error, **images})
    (run / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


@pytest.mark.parametrize("with_images", [True, False])
def test_curve_tells_images_seen_against_error(
    tmp_path: Path, with_images: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = tmp_path / "run", tmp_path / "out"
    write_log(run, with_images)
    stages = [{"from_step": 0, "batch": 4, "sizes": [[32, 64]]}]
    (run / "config.yaml").write_text(yaml.safe_dump({"stages": stages}))
    assert main(["curve", str(run), "--out", str(out), "--metric", "clips_abs_rel"]) == 0
    with (out / "scaling_curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["images"] for row in rows] == ["8", "16", "32"]
    assert [float(row["clips_abs_rel"]) for row in rows] == [0.4, 0.3, 0.25]
    assert (out / "scaling_curve.png").stat().st_size > 5000
    assert "0.2500 after 32 images, 0.3000 at half the images" in capsys.readouterr().out


def test_curve_of_something_else_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["curve", str(tmp_path)]) == 1
    assert "no folder of a run" in capsys.readouterr().err
    write_log(tmp_path / "run", with_images=False)
    assert main(["curve", str(tmp_path / "run"), "--metric", "abs"]) == 1
    assert "has no abs; it has clips_abs_rel" in capsys.readouterr().err
    assert main(["curve", str(tmp_path / "run")]) == 1
    assert "give --config" in capsys.readouterr().err


def test_images_follow_from_the_stages() -> None:
    stages = [{"from_step": 0, "batch": 16}, {"from_step": 10, "batch": 8}]
    assert [images_at(stages, step) for step in (0, 5, 10, 12)] == [0, 80, 160, 176]


def test_last_doubling_is_read_between_validations() -> None:
    images = (10.0, 40.0, 40.0 * 2**0.5)
    rows = [{"images": n, "e": e} for n, e in zip(images, (0.4, 0.2, 0.1), strict=True)]
    half, end = last_doubling(rows, "e") or (0.0, 0.0)
    assert half == pytest.approx(0.4 - 0.2 * 0.75)  # 28.3 is 1.5 of 2 octaves
    assert end == 0.1
    assert last_doubling(rows[:1], "e") is None


def test_an_override_that_is_no_yaml_is_named(place: Path) -> None:
    with pytest.raises(ConfigError, match=r"--set 'steps=\[1': the value is no YAML"):
        settings(place, "steps=[1")


def test_validation_on_what_is_trained_on_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tiny_base(tmp_path)
    values = tiny_dyfn_settings(tmp_path)
    shutil.rmtree(tmp_path / "data" / "clips" / "b_1")
    config = DyFNRunConfig.model_validate({**values, "steps": 1})
    with torch.no_grad():
        UnrolledTask(config, tmp_path / "latents").validate()
    assert "nothing is held out" in caplog.text


def test_frames_of_a_recording_are_validated_on_in_numeric_order(
    place: Path, tmp_path: Path
) -> None:
    for index in range(12):
        for name, image in (
            ("rgb", np.full((64, 64, 3), 20 * index, np.uint8)),
            ("depth", np.full((64, 64), 1000 + 100 * index, np.uint16)),
        ):
            (tmp_path / name).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / name / f"{index}.png"), image)
    np.savetxt(tmp_path / "K.txt", [[60, 0, 32], [0, 60, 32], [0, 0, 1]])
    config = settings(place, f"validation_rgbd={tmp_path}", "validation_stride=1")
    with torch.no_grad():
        (recorded,) = UnrolledTask(config, tmp_path / "latents").sequences["recorded"]
    found = recorded.depth.flatten(1).mean(1)
    torch.testing.assert_close(found, 1 + 0.1 * torch.arange(12.0))


def damaged_copy(place: Path, tmp_path: Path) -> str:
    """Setting of a copy of the data with a second training clip that cannot be read."""
    root = shutil.copytree(place / "data", tmp_path / "data")
    write_shard(root, "c_1", "clip", "train", 8, seed=3)
    for depth in (root / "clips" / "c_1").glob("*.png"):
        depth.write_bytes(b"damaged")
    return f"data=[{root}]"


def test_clips_that_cannot_be_read_are_counted_also_over_a_resume(
    place: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = damaged_copy(place, tmp_path)
    command = ["dyfn", str(place / "config.yaml"), "--set", data, "--set", "steps=6"]
    command += ["--set", "method.cache_draws=0", "--out"]
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert main([*command, str(whole)]) == 0
    counted = json.loads((whole / "results.json").read_text())["unreadable_clips"]
    assert counted > 0
    told = re.findall(r"could not be read, (\d+) x: .*c_1.*png", caplog.text)
    assert sum(map(int, told)) == counted
    assert main([*command, str(parts), "--max-steps", "3"]) == 0
    assert main([*command, str(parts), "--resume"]) == 0
    assert json.loads((parts / "results.json").read_text())["unreadable_clips"] == counted


def test_a_cache_that_holds_nothing_binds_nobody(place: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = ["dyfn", str(place / "config.yaml"), "--out", str(out)]
    data = damaged_copy(place, tmp_path)
    shutil.rmtree(tmp_path / "data" / "clips" / "a_1")
    assert main([*command, "--set", data]) == 1
    assert (out / "latents" / "cache.json").exists()
    assert main(command) == 0


def test_a_resume_of_nothing_is_refused_before_anything_is_made(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert main(["dyfn", str(place / "config.yaml"), "--out", str(out), "--resume"]) == 1
    assert f"nothing to resume: {out} holds no state.pt" in capsys.readouterr().err
    assert not out.exists()


def test_a_recording_in_the_place_of_the_config_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = tmp_path / "run.mcap"
    recording.write_bytes(bytes([0x89, 0x4D, 0xFF, 0xFE]))
    assert main(["dyfn", str(recording), "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert f"{recording} is no readable YAML file of settings (data are given with --data)" in told


@pytest.mark.parametrize("steps", ["0", "-1", "few"])
def test_steps_are_at_least_one(
    steps: str, place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["dyfn", str(place / "config.yaml"), "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit):
        main([*command, "--max-steps", steps])
    assert "--max-steps: expected a whole number of 1 or more" in capsys.readouterr().err
