"""Configs and run folders of `dyfn-train stabilizer` and `scale` go on, in today's form."""

from __future__ import annotations

import copy
import json
import logging
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

from dyfn_core.cli.train import main
from dyfn_core.training.dyfn_config import DyFNRunConfig
from dyfn_core.training.former_config import former_command, translated
from dyfn_core.training.loop.checkpoint import read_state, write_state
from dyfn_core.training.loop.run_folder import read_log
from tests.support.training_toys import tiny_base, tiny_dyfn_settings

WITHOUT_EFFECT = {"decoded": 3, "temporal_weight": 5.0, "ssi_weight": 4.0}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Settings of today of a small unrolled run."""
    folder = tmp_path_factory.mktemp("former")
    tiny_base(folder)
    return tiny_dyfn_settings(folder) | {"log_every": 1, "steps": 3}


def settings(tiny: dict[str, Any], command: str) -> dict[str, Any]:
    """Settings of today for what a former command trained."""
    found = copy.deepcopy(tiny)
    if command == "scale":
        clips = {name: found["method"][name] for name in ("cache_length", "length", "clips")}
        found["method"] = {"kind": "linearized", "gru_input_draws": 2, "noise": 0.2, **clips}
    return found


def former(today: dict[str, Any]) -> dict[str, Any]:
    """The same settings as an earlier version took them."""
    method = dict(today["method"])
    kept = {name: value for name, value in today.items() if name not in ("method", "dyfn")}
    if method.pop("kind") == "linearized":
        method["summary_draws"] = method.pop("gru_input_draws")
    method |= {name: v for name, v in method.pop("objective", {}).items() if name != "kind"}
    return {**kept, "stabilizer": today["dyfn"], **method}


def written(path: Path, values: dict[str, Any]) -> str:
    path.write_text(yaml.safe_dump(values))
    return str(path)


def losses(out: Path) -> list[float]:
    return [line["loss"] for line in read_log(out / "log.jsonl") if line["group"] == "train"]


@pytest.mark.parametrize("command", ["stabilizer", "scale"])
def test_former_name_and_config_train_as_todays(
    command: str, tiny: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    today = settings(tiny, command)
    new = written(tmp_path / "new.yaml", today)
    old = written(tmp_path / "old.yaml", former(today))
    assert main(["dyfn", new, "--out", str(tmp_path / "new")]) == 0
    assert main([command, old, "--out", str(tmp_path / "old")]) == 0
    kind = today["method"]["kind"]
    assert f"`{command}` is now `dyfn` with method.kind '{kind}'" in capsys.readouterr().err
    assert losses(tmp_path / "old") == losses(tmp_path / "new")
    configs = [yaml.safe_load((tmp_path / n / "config.yaml").read_text()) for n in ("old", "new")]
    assert configs[0] == configs[1]


@pytest.mark.parametrize("command", ["stabilizer", "scale"])
def test_former_config_is_refused_by_dyfn_with_what_takes_it(
    command: str, tiny: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = written(tmp_path / "old.yaml", former(settings(tiny, command)))
    assert main(["dyfn", old, "--out", str(tmp_path / "out")]) == 1
    assert f"is a config of `dyfn-train {command}`, which still takes" in capsys.readouterr().err


def test_config_of_the_other_method_is_refused(
    tiny: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new = written(tmp_path / "new.yaml", settings(tiny, "scale"))
    assert main(["stabilizer", new, "--out", str(tmp_path / "out")]) == 1
    assert "has method.kind 'linearized': give it to `dyfn`" in capsys.readouterr().err


def test_settings_without_effect_are_left_out_and_named(
    tiny: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    old = former(settings(tiny, "scale")) | WITHOUT_EFFECT
    assert former_command(old) == "scale"
    with caplog.at_level(logging.WARNING):
        new = translated(old, "scale")
    assert "left out, as they had no effect: decoded, ssi_weight, temporal_weight" in caplog.text
    DyFNRunConfig.model_validate(new)


def test_former_objective_is_the_papers_and_its_silent_weights_are_named(
    tiny: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    old = former(settings(tiny, "stabilizer"))
    old |= {"objective": {"form": "released", "edge": 0.1}, "frame_weight": 3.0}
    with caplog.at_level(logging.WARNING):
        new = translated(old, "stabilizer")
    assert new["method"]["objective"] == {"kind": "paper", "form": "released", "edge": 0.1}
    assert "left out, as they had no effect: decoded, frame_weight" in caplog.text


def test_former_overrides_on_a_config_of_today() -> None:
    new = {"base": "x", "dyfn": {"pool": 2}, "method": {"kind": "unrolled", "clips": 4}}
    given = {"stabilizer": {"hidden": 8}, "clips": 2, "frame_weight": 0.1}
    found = translated({**new, **given}, "stabilizer")
    assert found["dyfn"] == {"pool": 2, "hidden": 8}
    objective = {"kind": "terms", "frame_weight": 0.1}
    assert found["method"] == {"kind": "unrolled", "clips": 2, "objective": objective}


def aged(out: Path) -> None:
    """Make the folder of a run what an earlier version left."""
    values = former(yaml.safe_load((out / "config.yaml").read_text()))
    written(out / "config.yaml", values)
    write_state(out, {**read_state(out), "config": values})
    if not (out / "gru_inputs").exists():
        return
    cache = (out / "gru_inputs").rename(out / "summaries")
    meta = json.loads((cache / "cache.json").read_text())
    meta["contents"][0] = "summary"
    (cache / "cache.json").write_text(json.dumps(meta))
    for path in cache.glob("*.safetensors"):
        parts = load_file(path)
        parts["summary"] = parts.pop("gru_input")
        save_file(parts, path)


@pytest.mark.parametrize("command", ["stabilizer", "scale"])
@pytest.mark.parametrize("todays", [True, False])
def test_former_run_folders_resume(
    command: str,
    todays: bool,
    tiny: dict[str, Any],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    today = settings(tiny, command)
    new = written(tmp_path / "new.yaml", today)
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    assert main(["dyfn", new, "--out", str(whole)]) == 0
    assert main(["dyfn", new, "--out", str(halves), "--max-steps", "1"]) == 0
    aged(halves)
    given = ["dyfn", new] if todays else [command, written(tmp_path / "old.yaml", former(today))]
    with caplog.at_level(logging.WARNING):
        assert main([*given, "--out", str(halves), "--resume"]) == 0
    assert losses(halves) == losses(whole)
    assert "resuming with another" not in caplog.text
    ours, theirs = (read_state(out)["model"] for out in (halves, whole))
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)
    assert not (halves / "gru_inputs").exists()
