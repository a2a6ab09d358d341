"""DyFN from the base's own scale errors: what the recurrence is given, what training changes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

from dyfn_core.cli.train import main
from dyfn_core.data.clips import draw_batch, find_sequences
from dyfn_core.models.base import AffinePoints, Latent
from dyfn_core.models.checkpoints import load_model
from dyfn_core.training.config import ConfigError, read_config
from dyfn_core.training.dyfn_config import DyFNRunConfig
from dyfn_core.training.loop.run_folder import read_log
from dyfn_core.training.tasks.dyfn_linearized import LinearizedTask
from dyfn_core.training.tasks.gru_input_cache import (
    decoded_with_slope,
    decoded_z,
    gru_inputs,
    mean_log,
)
from dyfn_core.training.tasks.latent_cache import encode_clips
from tests.support.seeded import normal, redraw
from tests.support.training_toys import tiny_base, tiny_dyfn_settings


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """base.safetensors, data/ and config.yaml."""
    folder = tmp_path_factory.mktemp("scale")
    tiny_base(folder)
    settings = tiny_dyfn_settings(folder)
    clips = {name: settings["method"][name] for name in ("cache_length", "length", "clips")}
    settings["method"] = {"kind": "linearized", "gru_input_draws": 2, **clips}
    settings["dyfn"] |= {"standardize": True}
    settings["log_every"] = 1
    (folder / "config.yaml").write_text(yaml.safe_dump(settings))
    return folder


def task(place: Path, cache: Path, *overrides: str) -> LinearizedTask:
    return LinearizedTask(read_config(place / "config.yaml", DyFNRunConfig, list(overrides)), cache)


def test_gru_inputs_hold_the_scale_error_of_every_frame(place: Path, tmp_path: Path) -> None:
    made = task(place, tmp_path)
    batch = draw_batch(made.source, find_sequences(made.source, "train"), 0)
    parts = gru_inputs(made.model, batch)
    clips = encode_clips(made.model, batch)
    latent = Latent(clips.latent[0, 2:3].float(), (16, 32), clips.network_size)
    affine = made.model.decode(latent)
    assert isinstance(affine, AffinePoints)
    z, true = affine.points[0, ..., 2], clips.depth[0, 2].float()
    known = torch.isfinite(true) & (true > 0)
    fx, fy = (float(v) for v in batch.intrinsics[0, 2, :2])
    focal = 0.5 * (fx * 64 + fy * 32) / math.hypot(64, 32)
    wanted = (z[known].log() - (true[known] / focal).log()).mean()
    torch.testing.assert_close(parts["error"][0, 2], wanted, rtol=1e-4, atol=1e-4)
    assert parts["gru_input"].shape == (1, 4, 8, 2, 4)


def test_samples_pair_the_bases_depth_with_the_true_one(place: Path, tmp_path: Path) -> None:
    made = task(place, tmp_path)
    batch = draw_batch(made.source, find_sequences(made.source, "train"), 0)
    parts = gru_inputs(made.model, batch)
    clips = encode_clips(made.model, batch)
    latent = Latent(clips.latent[0].float(), (16, 32), clips.network_size)
    z = decoded_z(made.model, latent).detach()
    assert parts["depth"].shape == parts["truth"].shape == (1, 4, 48)
    rows, columns = (torch.arange(6) * 16 + 8) // 6, torch.arange(8) * 4 + 2
    torch.testing.assert_close(parts["depth"][0, 1], z[1][rows][:, columns].flatten())
    true = clips.depth[0, 1].float()[rows][:, columns].flatten()
    known = torch.isfinite(true) & (true > 0)
    assert torch.equal(torch.isfinite(parts["truth"][0, 1]), known)
    assert torch.equal(parts["truth"][0, 1][known], true[known])


def test_slope_is_how_the_scale_moves_with_the_statistics(place: Path, tmp_path: Path) -> None:
    made = task(place, tmp_path)
    features = normal(3, 2, 8, 4, 8) * torch.tensor([1.0, 3.0]).view(2, 1, 1, 1)
    latent, depth = Latent(features, (16, 32), (32, 64)), torch.ones(2, 16, 32)
    z, level, slope = decoded_with_slope(made.model, latent, depth)
    torch.testing.assert_close(z, decoded_z(made.model, latent).detach())
    torch.testing.assert_close(level, z.log().mean((1, 2)))
    # Mostly along the slope, so that no sum of terms of both signs is compared.
    change = 0.003 * (torch.nn.functional.normalize(slope) + 0.25 * normal(4, 2, 16))
    std, mean = torch.std_mean(features, dim=(-2, -1), keepdim=True)
    gamma, beta = (part.view(2, 8, 1, 1) for part in change.chunk(2, 1))
    moved = replace(latent, features=gamma.exp() * (features - mean) + mean + std * beta)
    with torch.no_grad():
        after, before = (decoded_z(made.model, one) for one in (moved, latent))
        found = mean_log(after, depth) - mean_log(before, depth)
    wanted = (slope * change).sum(1)
    torch.testing.assert_close(found, wanted, rtol=0.05, atol=0)
    assert (slope[0] - slope[1]).norm() > 0.1 * slope.norm()  # each frame has its own


def test_training_lowers_the_spread_of_the_scales(place: Path, tmp_path: Path) -> None:
    made = task(
        place,
        tmp_path,
        *(f"method.{text}" for text in ("noise=0", "length=4", "clips=2", "change_weight=0")),
    )
    batch = next(iter(made.batches(0)))
    # Of unit length, else the random base decides how much a correction can do.
    slope = torch.nn.functional.normalize(batch.slope.float(), dim=-1)
    batch = replace(batch, slope=slope)
    optimizer = torch.optim.Adam(made.groups()[0]["params"], lr=0.05)
    spreads = []
    for _ in range(100):
        loss, values = made.loss(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        spreads.append(values["spread"])
    assert spreads[0] == pytest.approx(values["base_spread"], rel=1e-4)
    assert spreads[-1] < 0.7 * spreads[0]


def test_command_trains_dyfn_alone_and_keeps_the_usual_statistics(
    place: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    assert main(["dyfn", str(place / "config.yaml"), "--out", str(out)]) == 0
    base, trained = load_model(place / "base.safetensors"), load_model(out / "model.safetensors")
    assert trained.stabilizer is not None
    for name, value in base.state_dict().items():
        torch.testing.assert_close(trained.state_dict()[name], value, rtol=0, atol=0)
    assert float(trained.stabilizer.get_buffer("usual_std").std()) > 0
    scores = [line for line in read_log(out / "log.jsonl") if line["group"] == "validation"]
    assert {"rendered_base_video", "rendered_dyfn_video"} <= set(scores[-1])


def test_the_papers_form_has_no_corrections_to_learn(place: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="'residual', got 'paper'"):
        task(place, tmp_path, "dyfn.form=paper")


def test_gru_inputs_of_another_recurrence_are_refused(place: Path, tmp_path: Path) -> None:
    task(place, tmp_path)
    with pytest.raises(ConfigError, match="recurrence"):
        task(place, tmp_path, "dyfn.pool=1")


def test_validation_scores_the_frozen_base_once(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = task(place, tmp_path)
    assert made.model.stabilizer is not None
    decoded: list[int] = []
    decode = LinearizedTask.decode
    monkeypatch.setattr(
        LinearizedTask, "decode", lambda self, *given: decoded.append(1) or decode(self, *given)
    )
    with torch.no_grad():
        first, frames = made.validate(), len(decoded)
        redraw([made.model.stabilizer.gamma_head.weight], 0.5, seed=0)  # type: ignore[union-attr]
        second = made.validate()
    assert len(decoded) == frames + frames // 2
    assert second["rendered_base_video"] == first["rendered_base_video"]
    assert first["rendered_dyfn_video"] == first["rendered_base_video"]  # untrained
    assert second["rendered_dyfn_video"] != first["rendered_dyfn_video"]
