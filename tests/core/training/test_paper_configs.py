"""The configs of the paper: their values, and both run on made data at a tiny size."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dyfn_core.cli.train import main
from dyfn_core.models.checkpoints import load_model, save_model
from dyfn_core.training.config import ConfigError, read_config
from dyfn_core.training.dyfn_config import DyFNRunConfig, PaperObjective, UnrolledMethod
from dyfn_core.training.loop.processes import Processes
from dyfn_core.training.loop.trainer import Trainer
from tests.core.models.test_dyfn_bases import tiny
from tests.support.made_frames import write_shard
from tests.support.training_toys import ToyTask, run_toy, toy_config

PAPER, DAV2 = Path("train_dyfn_paper.yaml"), Path("train_dyfn_dav2.yaml")
SMALL = {  # of the run, nothing of the method but its size
    "stages": [{"from_step": 0, "batch": 2, "area": [9000, 12000], "aspect": [0.8, 1.3]}],
    "steps": 2,
    "threads": 1,
    "device": "cpu",
    "log_every": 1,
    "picture_every": 2,
    "validate_every": 2,
    "validation_clips": 1,
    "loader_workers": 2,
    "dyfn.hidden": 8,
    "method.length": 3,
    "method.cache_length": 3,
    "method.strides": [1, 2],
    "method.clips": 2,
}
LEVELS = [{"alpha": 0.25, "anchors": 4, "resolution": 4}]


def test_the_config_holds_what_the_paper_and_the_released_configuration_say() -> None:
    config = read_config(PAPER, DyFNRunConfig, [])
    assert {data.kind: data.weight for data in config.data} == {
        "irs": 20.1, "point_odyssey": 27.8, "dynamic_replica": 17.4, "spring": 2.4,
        "midair": 9.3, "ken_burns": 5.6, "tartanair": 17.4,
    }  # fmt: skip
    method = config.method
    assert isinstance(method, UnrolledMethod)
    assert (method.length, method.strides, method.clips, config.parts) == (12, (1, 5), 4, 2)
    assert isinstance(method.objective, PaperObjective)
    assert method.objective.objective().weights() == {
        "align_first": 1.0, "temporal": 0.1, "normal": 1.0, "mask": 1.0,
        "local_0": 1.0, "local_1": 1.0, "local_2": 1.0,
    }  # fmt: skip
    assert [level.alpha for level in method.objective.objective().levels] == [1 / 4, 1 / 16, 1 / 32]
    assert [stage.tokens for stage in config.stages] == [(1200, 1200), (1200, 2500)]
    disparity = read_config(DAV2, DyFNRunConfig, [])
    same = ("data", "learning_rate", "schedule", "fov", "depth_clamp", "ema_decay", "parts")
    assert all(getattr(disparity, name) == getattr(config, name) for name in same)


def test_the_rate_is_constant_and_then_halved(tmp_path: Path) -> None:
    changes = {"schedule": "halving", "constant_steps": 2, "halve_every": 2, "warmup_steps": 0}
    run_toy(tmp_path / "run", steps=7, **changes)
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    rates = [line["rate"] / 1e-2 for line in lines if line["group"] == "train"]
    assert rates == pytest.approx([1, 1, 1, 1, 0.5, 0.5, 0.25])
    config = toy_config(schedule="halving")  # the released numbers
    trainer = Trainer(ToyTask(), config, tmp_path / "other", False, Processes(config))
    for step, share in ((999, 1), (5999, 1), (6000, 0.5), (11000, 0.25)):
        trainer.step = step
        trainer._set_rates()
        assert trainer.optimizer.param_groups[0]["lr"] == pytest.approx(1e-2 * share)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    write_shard(root, "a_1", "clip", "train", 8, seed=2)
    write_shard(root, "b_1", "clip", "held_out", 5, seed=4)
    return root


def overrides(data: Path, base: Path, more: dict[str, Any]) -> list[str]:
    values = {**SMALL, "data": [str(data)], "base": str(base), **more}
    return [w for key, value in values.items() for w in ("--set", f"{key}={json.dumps(value)}")]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "family", "more"),
    [
        (PAPER, "moge", {"method.objective.levels": LEVELS, "method.objective.resolution": 8}),
        (DAV2, "dav2", {"method.objective.decoded": 3}),
    ],
)
def test_it_runs_on_made_data(
    data: Path,
    tmp_path: Path,
    path: Path,
    family: str,
    more: dict[str, Any],
    capsys: pytest.CaptureFixture[str],
) -> None:
    save_model(tiny(family), tmp_path / "base.safetensors")
    sets = overrides(data, tmp_path / "base.safetensors", more)
    out = tmp_path / "run"
    assert main(["dyfn", str(path), "--out", str(out), "--dry-run", *sets]) == 0
    assert not out.exists()
    told = capsys.readouterr().out
    assert "2 steps with images up to" in told
    assert "s a step (encoder" in told
    assert "GiB" in told
    assert main(["dyfn", str(path), "--out", str(out), *sets]) == 0
    trained = load_model(out / "model.safetensors")
    assert trained.stabilizer is not None
    assert trained.stabilizer.config.form == "paper"
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    train = [line for line in lines if line["group"] == "train"]
    assert [line["images"] for line in train] == [6, 12]


def test_a_stage_has_sizes_or_ranges() -> None:
    for stage in (
        '{"from_step": 0, "batch": 1}',
        '{"from_step": 0, "batch": 1, "area": [100, 200]}',
        '{"from_step": 0, "batch": 1, "sizes": [[32, 32]], "area": [9, 9], "aspect": [1, 1]}',
    ):
        with pytest.raises(ConfigError, match="either `sizes`, or `area` and `aspect`"):
            read_config(PAPER, DyFNRunConfig, [f"stages=[{stage}]"])


def test_a_dry_run_of_another_method_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["dyfn", "train_dyfn_mini.yaml", "--out", str(tmp_path), "--dry-run"]) == 1
    assert "method 'linearized' has none" in capsys.readouterr().err
