"""Averaging checkpoints: by value, and refused when they do not belong together."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dyfn_core.cli.train import main
from dyfn_core.models.checkpoints import load_model, save_model
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.mini import MiniConfig, MiniModel

SMALL = MiniConfig(latent_channels=16, stage_channels=(16, 8), context_layers=0)


def saved(folder: Path, name: str, seed: int, config: MiniConfig = SMALL) -> Path:
    torch.manual_seed(seed)
    model = MiniModel(config)
    model.stabilizer = build_dyfn(model.latent_channels, DyFNConfig(hidden=4, form="residual"))
    path = folder / f"{name}.safetensors"
    save_model(model, path)
    return path


def test_average_is_the_weighted_mean_of_the_base_with_the_first_dyfn(tmp_path: Path) -> None:
    a, b = saved(tmp_path, "a", 1), saved(tmp_path, "b", 2)
    out = tmp_path / "mean.safetensors"
    assert main(["average", str(a), str(b), "--shares", "3", "1", "--out", str(out)]) == 0
    one, two, mean = (load_model(path).state_dict() for path in (a, b, out))
    differing = 0
    for name, value in mean.items():
        if name.startswith("stabilizer."):
            assert torch.equal(value, one[name]), name
        elif value.is_floating_point():
            torch.testing.assert_close(value, 0.75 * one[name] + 0.25 * two[name])
            differing += not torch.equal(one[name], two[name])
    assert differing > 10


def test_equal_shares_are_the_default(tmp_path: Path) -> None:
    a, b = saved(tmp_path, "a", 1), saved(tmp_path, "b", 2)
    out = tmp_path / "mean.safetensors"
    assert main(["average", str(a), str(b), "--out", str(out)]) == 0
    one, two, mean = (load_model(path).state_dict() for path in (a, b, out))
    name = next(n for n in mean if n.endswith("weight") and not torch.equal(one[n], two[n]))
    torch.testing.assert_close(mean[name], (one[name] + two[name]) / 2)


@pytest.mark.parametrize(
    ("shares", "message"),
    [(["1"], "a share of each"), (["1", "0"], "must be positive"), (["1", "inf"], "positive")],
)
def test_bad_shares_are_named(
    tmp_path: Path, shares: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = saved(tmp_path, "a", 1), saved(tmp_path, "b", 2)
    out = tmp_path / "mean.safetensors"
    assert main(["average", str(a), str(b), "--shares", *shares, "--out", str(out)]) == 1
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_another_architecture_is_refused_naming_file_and_tensor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wider = MiniConfig(latent_channels=24, stage_channels=(16, 8), context_layers=0)
    a, b = saved(tmp_path, "a", 1), saved(tmp_path, "b", 2, wider)
    assert main(["average", str(a), str(b), "--out", str(tmp_path / "mean.safetensors")]) == 1
    told = capsys.readouterr().err
    assert (
        str(b) in told
        and "not of one architecture" in told
        and "(16, 26, 1, 1) in the second" in told
    )
