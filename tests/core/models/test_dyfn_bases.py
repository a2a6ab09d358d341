"""`dyfn-train dyfn` on every family: only DyFN changes, and its error is really followed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from dyfn_core.cli.train import main
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import load_model, save_model
from dyfn_core.models.depth_anything import DepthAnythingConfig, DepthAnythingModel
from dyfn_core.models.mini import MiniConfig, MiniModel
from dyfn_core.models.moge import MoGeConfig, MoGeModel
from tests.support.bases import small_da3, small_moge2
from tests.support.made_frames import write_data_set

RUN: dict[str, Any] = {
    "kinds": ["clip"],
    "stages": [{"from_step": 0, "batch": 1, "sizes": [[32, 64]]}],
    "dyfn": {"kind": "convgru", "hidden": 8},
    "method": {
        "kind": "unrolled",
        "cache_draws": 2,
        "cache_length": 4,
        "strides": [1, 1],
        "clips": 1,
        "length": 4,
    },
    "steps": 3,
    "threads": 1,
    "log_every": 1,
    "picture_every": 3,
    "validate_every": 3,
    "validation_clips": 1,
    "warmup_steps": 1,
    "learning_rate": 0.01,
}


def tiny(family: str) -> GeometryModel:
    torch.manual_seed(0)
    if family == "mini":
        return MiniModel(MiniConfig(latent_channels=16, stage_channels=(16, 8)))
    if family == "moge":
        return MoGeModel(
            MoGeConfig(
                encoder="dinov2_vits14",
                dim_proj=32,
                dim_upsample=(32, 32, 32),
                remap_output="exp",
            )
        )
    if family == "moge2":
        return small_moge2()
    if family == "da3":
        return small_da3("mono")
    made = DepthAnythingModel(DepthAnythingConfig())
    torch.nn.init.constant_(made.depth_head.scratch.output_conv2[2].bias, 0.5)  # type: ignore[arg-type]
    return made


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data_set(tmp_path_factory.mktemp("data"))


def train(folder: Path, data: Path, family: str, objective: dict[str, Any]) -> list[dict[str, Any]]:
    base = folder / "base.safetensors"
    save_model(tiny(family), base)
    config = folder / "config.yaml"
    settings = {**RUN, "data": [str(data)], "base": str(base)}
    settings["method"] = {**settings["method"], "objective": objective}
    config.write_text(yaml.safe_dump(settings))
    assert main(["dyfn", str(config), "--out", str(folder / "run")]) == 0
    return [json.loads(line) for line in (folder / "run" / "log.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("family", ["mini", "moge", "moge2", "dav2", "da3"])
def test_base_is_trained_on_and_stays_as_it_was(data: Path, family: str, tmp_path: Path) -> None:
    kind = "disparity" if family == "dav2" else "terms"
    log = train(tmp_path, data, family, {"kind": kind, "decoded": 3, "windows": [1, 2]})
    before = tiny(family).state_dict()
    trained = load_model(tmp_path / "run" / "model.safetensors")
    after = trained.state_dict()
    for key, value in before.items():
        assert torch.equal(after[key], value), key
    moved = [key for key in after if key.startswith("stabilizer.gamma_head.weight")]
    assert all(bool(after[key].any()) for key in moved)
    assert moved
    assert trained.stabilizer is not None
    assert trained.stabilizer.config.pool == (4 if family in ("dav2", "da3") else 1)
    (step, *_) = [line for line in log if line["group"] == "train"]
    names = {"ssi", "temporal"} if family == "dav2" else {"frame", "temporal", "align_first"}
    assert names <= set(step)
    assert ("spread" in step) == (family != "dav2")
    scores = [line for line in log if line["group"] != "train"]
    assert any("rendered_dyfn_video" in line for line in scores)


def test_the_whole_objective_can_train_it(data: Path, tmp_path: Path) -> None:
    level = {"alpha": 0.5, "anchors": 4, "resolution": 4}
    objective = {"kind": "paper", "levels": [level], "resolution": 6, "windows": [1, 2]}
    log = train(tmp_path, data, "mini", {**objective, "edge": 0.1})
    step = next(line for line in log if line["group"] == "train")
    assert {"align_first", "local_0", "normal", "mask", "edge", "temporal"} <= set(step)
    assert "frame" not in step  # the released code has it, the text not


def test_unknown_key_of_the_objective_names_the_nearest(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_model(tiny("mini"), tmp_path / "base.safetensors")
    config = tmp_path / "config.yaml"
    method = {**RUN["method"], "objective": {"kind": "paper", "temporl": 1.0}}
    wrong = {"method": method, "base": str(tmp_path / "base.safetensors")}
    config.write_text(yaml.safe_dump({**RUN, "data": [str(data)], **wrong}))
    assert main(["dyfn", str(config), "--out", str(tmp_path / "run")]) != 0
    assert "unknown key 'temporl', did you mean 'temporal'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("family", "kind", "mended"),
    [
        (
            "dav2",
            "terms",
            "{kind: disparity, decoded: 8, windows: [1, 2], temporal_weight: 0.3}",
        ),
        ("dav2", "paper", "{kind: disparity}"),
        (
            "mini",
            "disparity",
            "{kind: terms, decoded: 8, windows: [1, 2], temporal_weight: 0.3}",
        ),
    ],
)
def test_objective_for_another_output_is_refused_with_what_mends_it(
    family: str,
    kind: str,
    mended: str,
    data: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    save_model(tiny(family), tmp_path / "base.safetensors")
    own = {} if kind == "paper" else {"windows": [1, 2], "temporal_weight": 0.3}
    method = {**RUN["method"], "objective": {"kind": kind, **own}}
    config = tmp_path / "config.yaml"
    values: dict[str, Any] = {"method": method, "data": [str(data)]}
    values["base"] = str(tmp_path / "base.safetensors")
    # A size at which the paper's objective can be had.
    values["stages"] = [{"from_step": 0, "batch": 1, "sizes": [[192, 256]]}]
    config.write_text(yaml.safe_dump({**RUN, **values}))
    assert main(["dyfn", str(config), "--out", str(tmp_path / "run")]) == 1
    assert f"set method.objective to {mended}" in capsys.readouterr().err
