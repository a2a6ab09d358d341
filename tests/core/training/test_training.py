"""dyfn-train: configs, both kinds of run, resuming, and what stops a run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
import yaml

from dyfn_core.cli.train import main
from dyfn_core.models.checkpoints import load_model, save_model
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.mini import MiniModel
from dyfn_core.training.config import (
    BaseRunConfig,
    ConfigError,
    RunConfig,
    config_folders,
    read_config,
)
from dyfn_core.training.dyfn_config import DyFNRunConfig
from dyfn_core.training.loop.trainer import Trainer, TrainingError
from dyfn_core.training.tasks.base import BaseTask
from dyfn_core.training.tasks.dyfn_unrolled import UnrolledTask
from tests.support.made_frames import write_data_set

TINY = {
    "model": {"latent_channels": 16, "stage_channels": [16, 8], "context_channels": 24},
    "stages": [{"from_step": 0, "batch": 2, "sizes": [[32, 64]]}],
    "steps": 6,
    "threads": 1,
    "log_every": 1,
    "picture_every": 2,
    "validate_every": 3,
    "validation_frames": 2,
    "warmup_steps": 2,
}
BASE_ALONE = ("model", "validation_frames")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data_set(tmp_path_factory.mktemp("data"))


def write_config(folder: Path, data: Path, **changes: object) -> Path:
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump({**TINY, "data": [str(data)], **changes}))
    return path


def read_log(out: Path, group: str = "train") -> list[dict[str, float]]:
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return [line for line in lines if line["group"] == group]


@pytest.fixture(scope="module")
def base_run(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished, uninterrupted base run of six steps."""
    folder = tmp_path_factory.mktemp("base")
    assert main(["base", str(write_config(folder, data)), "--out", str(folder / "run")]) == 0
    return folder / "run"


def test_base_run_leaves_a_model_logs_and_pictures(base_run: Path) -> None:
    model = load_model(base_run / "model.safetensors")
    assert isinstance(model, MiniModel)
    assert model.settings.folded
    steps = [line["step"] for line in read_log(base_run)]
    assert steps == [1, 2, 3, 4, 5, 6]
    validation = read_log(base_run, "validation")[-1]
    assert 0 < validation["rendered_abs_rel"] < 2
    assert (base_run / "best.safetensors").exists()
    assert len(list((base_run / "pictures").glob("*.jpg"))) == 3
    assert list((base_run / "tensorboard").iterdir())


def test_resumed_run_ends_as_an_uninterrupted_one(
    data: Path, base_run: Path, tmp_path: Path
) -> None:
    config, out = str(write_config(tmp_path, data)), str(tmp_path / "run")
    assert main(["base", config, "--out", out, "--max-steps", "3"]) == 0
    assert main(["base", config, "--out", out, "--resume"]) == 0
    losses = [line["loss"] for line in read_log(tmp_path / "run")]
    assert losses == [line["loss"] for line in read_log(base_run)]
    ours = load_model(tmp_path / "run" / "model.safetensors").state_dict()
    theirs = load_model(base_run / "model.safetensors").state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_repeated_batch_is_learned(data: Path, tmp_path: Path) -> None:
    config = read_config(write_config(tmp_path, data), BaseRunConfig, [])
    task = BaseTask(config)
    batch = next(task.batches(0))
    optimizer = torch.optim.Adam([p for group in task.groups() for p in group["params"]], 3e-3)
    losses = []
    for _ in range(12):
        torch.manual_seed(0)
        optimizer.zero_grad()
        loss, values = task.loss(batch)
        loss.backward()
        optimizer.step()
        losses.append(values["loss"])
    assert losses[-1] < 0.8 * losses[0]


def test_frozen_encoder_parts_keep_their_imagenet_weights(base_run: Path) -> None:
    model = load_model(base_run / "model.safetensors")
    fresh = MiniModel()
    fresh = MiniModel(type(fresh.settings)(folded=False))
    fresh.load_imagenet_encoder()
    before = fresh.folded().encoder.state_dict()
    after = model.encoder.state_dict()  # type: ignore[operator, union-attr]
    assert torch.equal(before["stem.weight"], after["stem.weight"])
    assert torch.equal(before["blocks.9.depthwise.weight"], after["blocks.9.depthwise.weight"])
    assert not torch.equal(before["blocks.9.project.weight"], after["blocks.9.project.weight"])


DYFN = {
    "stages": [{"from_step": 0, "batch": 2, "sizes": [[32, 64], [64, 32]]}],
    "dyfn": {"kind": "convgru", "form": "residual", "hidden": 8, "pool": 2},
    "method": {
        "kind": "unrolled",
        "cache_draws": 3,
        "cache_length": 5,
        "strides": [1, 2],
        "clips": 2,
        "length": 3,
        "objective": {"kind": "terms", "decoded": 3},
    },
    "validation_clips": 2,
}


def dyfn_config(folder: Path, data: Path, base: Path, **changes: object) -> Path:
    values = {key: value for key, value in TINY.items() if key not in BASE_ALONE}
    values |= {"data": [str(data)], "base": str(base / "model.safetensors")}
    path = folder / "dyfn.yaml"
    path.write_text(yaml.safe_dump({**values, **DYFN, **changes}))
    return path


def test_dyfn_run_changes_dyfn_alone(data: Path, base_run: Path, tmp_path: Path) -> None:
    config = dyfn_config(tmp_path, data, base_run, learning_rate=0.01)
    assert main(["dyfn", str(config), "--out", str(tmp_path / "run")]) == 0
    model = load_model(tmp_path / "run" / "model.safetensors").state_dict()
    base = load_model(base_run / "model.safetensors").state_dict()
    assert all(torch.equal(model[name], base[name]) for name in base)
    assert float(model["stabilizer.gamma_head.weight"].abs().sum()) > 0
    validation = read_log(tmp_path / "run", "validation")
    assert {"rendered_base_video", "rendered_dyfn_video"} <= set(validation[0])


def test_dyfn_run_resumes_from_its_cache(
    data: Path, base_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = str(dyfn_config(tmp_path, data, base_run))
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    cache = ["--set", f"method.cache={tmp_path / 'latents'}"]
    assert main(["dyfn", config, "--out", str(whole), *cache]) == 0
    assert "making latents:" in capsys.readouterr().err  # minutes, also in a log file
    assert main(["dyfn", config, "--out", str(halves), *cache, "--max-steps", "2"]) == 0
    assert main(["dyfn", config, "--out", str(halves), *cache, "--resume"]) == 0
    losses = [[line["loss"] for line in read_log(out)] for out in (whole, halves)]
    assert losses[0] == losses[1]


def test_latents_of_another_model_are_refused(data: Path, base_run: Path, tmp_path: Path) -> None:
    cache = tmp_path / "latents"
    path = dyfn_config(tmp_path, data, base_run)
    config = read_config(path, DyFNRunConfig, [f"method.cache={cache}"])
    UnrolledTask(config, tmp_path)
    (cache / "cache.json").write_text(json.dumps({"model": "other", "source": {}}))
    with pytest.raises(ConfigError, match="another model, source"):
        UnrolledTask(config, tmp_path)


def test_run_without_finite_losses_ends_with_the_reason(data: Path, tmp_path: Path) -> None:
    config = read_config(write_config(tmp_path, data, most_bad_steps=2), BaseRunConfig, [])
    task = BaseTask(config)
    with torch.no_grad():
        task.model.neck.project_fine.weight.fill_(torch.nan)
    trainer = Trainer(task, config, tmp_path / "run", resume=False)
    with pytest.raises(TrainingError, match="no finite loss or gradient in 3 steps"):
        trainer.train()


def test_folder_with_a_run_is_not_overwritten(
    data: Path, base_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = str(write_config(tmp_path, data))
    assert main(["base", config, "--out", str(base_run)]) == 1
    assert "already holds a run" in capsys.readouterr().err
    assert main(["base", config, "--out", str(tmp_path / "no"), "--resume"]) == 1
    assert "nothing to resume" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["learning_rat=1"], "unknown key 'learning_rat', did you mean 'learning_rate'"),
        (["stages=[{from_step: 0, batch: 1, sizes: [[30, 64]]}]"], "multiples of 32"),
        (["stages=[{from_step: 3, batch: 1, sizes: [[32, 64]]}]"], "start at step 0"),
        (["steps=0"], "steps: "),
        (["steps"], "expected key=value"),
        (["seed.deep=1"], "seed holds no settings"),
    ],
)
def test_bad_settings_are_named(
    data: Path, tmp_path: Path, overrides: list[str], message: str
) -> None:
    path = write_config(tmp_path, data, seed=0)
    with pytest.raises(ConfigError, match=message.replace("[", r"\[")):
        read_config(path, BaseRunConfig, overrides)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("train_base_mini.yaml", BaseRunConfig),
        ("train_base_mini_more.yaml", BaseRunConfig),
        ("train_dyfn_mini.yaml", DyFNRunConfig),
        ("train_dyfn_unrolled_mini.yaml", DyFNRunConfig),
        ("train_experiments.yaml", DyFNRunConfig),
    ],
)
def test_shipped_configs_are_found_by_name_from_anywhere(
    name: str, kind: type[RunConfig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = read_config(Path("config") / name, kind, [])
    assert read_config(Path(name), kind, []) == config


def test_configs_are_found_beside_an_installed_package(tmp_path: Path) -> None:
    installed = tmp_path / "share" / "dyfn_ros" / "config"
    installed.mkdir(parents=True)
    (installed / "train_base_mini.yaml").touch()
    module = tmp_path / "lib" / "python3.12" / "site-packages" / "dyfn_core" / "training" / "c.py"
    assert config_folders(module) == [installed]


def test_harm_above_the_limit_is_exit_code_1_and_told(
    data: Path, base_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = load_model(base_run / "model.safetensors")
    latent_channels = model.encode(torch.zeros(1, 3, 64, 64)).features.shape[1]
    model.stabilizer = build_dyfn(latent_channels, DyFNConfig(hidden=8, pool=4, form="residual"))
    save_model(model, tmp_path / "dyfn.safetensors")
    given = ["evaluate", str(tmp_path / "dyfn.safetensors"), "--data", str(data), "--stride", "3"]
    assert main([*given, "--most-harm", "1000"]) == 0
    assert main([*given, "--most-harm", "-99"]) == 1
    assert "held-out clips: DyFN's video AbsRel is" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["base", "CONFIG"], ["dyfn"]])
def test_data_that_are_nowhere_are_told_before_anything_is_made(
    words: list[str], data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = str(write_config(tmp_path, data, seed=0))
    given = [config if word == "CONFIG" else word for word in words]
    assert main([*given, "--data", str(tmp_path / "absent"), "--out", str(tmp_path / "run")]) == 1
    told = f"dyfn-train: data: {tmp_path / 'absent'} does not exist; --data [KIND=]PATH names"
    assert told in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_config_that_is_nowhere_names_the_shipped_ones(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no training config at .*none.yaml; shipped are "):
        read_config(tmp_path / "none.yaml", BaseRunConfig, [])


def test_evaluate_prints_the_controls(
    data: Path, base_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = str(base_run / "model.safetensors")
    assert main(["evaluate", model, "--data", str(data), "--stride", "3"]) == 0
    printed = capsys.readouterr().out
    assert all(f"| {name} |" in printed for name in ("ramp", "constant", "base", "ema", "frozen"))
    assert main(["evaluate", model, "--data", str(data), "--most-harm", "-99"]) == 0, "has no DyFN"
    assert main(["evaluate", model]) == 1
    assert "nothing to evaluate on" in capsys.readouterr().err
