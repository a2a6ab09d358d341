"""dyfn-train experiments: end to end on a tiny base and tiny rendered clips."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

from dyfn_core.cli.train import main
from dyfn_core.evaluation.empirical_study import change_statistics, statistics_grid
from dyfn_core.experiments.declared import EXPERIMENTS, find_experiments
from dyfn_core.experiments.report import ArmScores, trained_table, verdicts, write_section
from dyfn_core.models.base import Latent
from dyfn_core.models.mini import MiniModel
from dyfn_core.scoring.variants import VariantScore
from dyfn_core.training.config import read_config
from dyfn_core.training.dyfn_config import DyFNRunConfig
from tests.support.seeded import normal, uniform
from tests.support.training_toys import tiny_base, tiny_dyfn_settings

CONFIG = Path(__file__).resolve().parents[3] / "config" / "train_experiments.yaml"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("experiments")


@pytest.fixture(scope="module")
def base(place: Path) -> MiniModel:
    return tiny_base(place)


@pytest.fixture(scope="module")
def folder(base: MiniModel, place: Path) -> Path:
    """base.safetensors, data/ and config.yaml."""
    settings = yaml.safe_load(CONFIG.read_text()) | tiny_dyfn_settings(place)
    (place / "config.yaml").write_text(yaml.safe_dump(settings))
    return place


def run(folder: Path, *arguments: str) -> int:
    common = ["--config", str(folder / "config.yaml"), "--out", str(folder / "out")]
    common += ["--write", str(folder / "RESULTS.md"), "--stride", "2"]
    return main(["experiments", *arguments, *common])


def test_arms_are_trained_once_and_written_between_markers(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = folder / "RESULTS.md"
    results.write_text("# Results\n\nKept.\n")
    assert run(folder, "effect", "recurrence", "--seeds", "2") == 0
    text = results.read_text()
    assert text.startswith("# Results\n\nKept.\n")
    assert max(map(len, text.splitlines())) <= 110
    for row in ("ramp", "constant", "base", "ema", "frozen", "**DyFN**", "**ConvGRU**", "**GRU**"):
        assert f"| {row} |" in text
    dyfn = next(line for line in text.splitlines() if line.startswith("| **DyFN** |"))
    assert dyfn.count("±") == 4
    # DyFN and ConvGRU are the same settings, and so the same two runs.
    runs = sorted((folder / "out" / "runs").glob("*/seed_*/results.json"))
    assert len(runs) == 4
    stamps = [path.stat().st_mtime_ns for path in runs]
    assert run(folder, "recurrence", "--seeds", "2") == 0
    assert [path.stat().st_mtime_ns for path in runs] == stamps
    assert results.read_text() == text
    assert "Paper: Video AbsRel, ConvGRU and GRU" in capsys.readouterr().out


def test_seeds_share_the_cache_and_differ_in_their_runs(folder: Path) -> None:
    assert run(folder, "effect", "--seeds", "2") == 0
    (arm,) = {path.parent for path in (folder / "out" / "runs").glob("*/seed_*")} & {
        path.parents[1]
        for path in (folder / "out" / "runs").glob("*/seed_0/config.yaml")
        if yaml.safe_load(path.read_text())["dyfn"].get("kind", "convgru") == "convgru"
    }
    losses = [
        json.loads((arm / f"seed_{seed}" / "results.json").read_text())["score"] for seed in (0, 1)
    ]
    assert losses[0] != losses[1]
    assert len(list((folder / "out" / "latents").glob("*.safetensors"))) == 1


def test_long_sequences_are_scored_at_each_length_they_reach(folder: Path) -> None:
    assert run(folder, "long-sequences", "--seeds", "1", "--lengths", "2", "4", "400") == 0
    text = (folder / "RESULTS.md").read_text()
    assert "| video AbsRel of the first | 2 frames | 4 frames |" in text
    assert "1 with 2 frames or more, 1 with 4 frames or more" in text
    assert run(folder, "long-sequences", "--seeds", "1") == 0
    text = (folder / "RESULTS.md").read_text()
    assert "no sequence has 100 frames, the longest has 5" in text


def test_statistics_experiment_writes_table_and_figure(folder: Path) -> None:
    assert run(folder, "statistics") == 0
    assert "AbsRel after alignment" in (folder / "RESULTS.md").read_text()
    assert (folder / "figures" / "statistics_grid.png").stat().st_size > 5000


def test_grid_is_the_identity_at_one_and_one(base: MiniModel) -> None:
    latents = [Latent(2 + uniform(i, 1, 8, 4, 8), (32, 64), (32, 64)) for i in range(2)]
    grid = statistics_grid(base, latents, (0.5, 1.0, 2.0))
    assert grid.scale[1, 1] == pytest.approx(1, abs=1e-3)
    assert grid.shift[1, 1] == pytest.approx(0, abs=1e-3)
    assert grid.abs_rel[1, 1] < 1e-4
    assert grid.abs_rel[0, 2] > 1e-4


def test_changed_statistics_are_the_ones_asked_for() -> None:
    features = normal(0, 2, 3, 5, 6) * 4 + 7
    std, mean = torch.std_mean(features, dim=(-2, -1))
    new_std, new_mean = torch.std_mean(change_statistics(features, 0.5, 2.0), dim=(-2, -1))
    torch.testing.assert_close(new_mean, 0.5 * mean)
    torch.testing.assert_close(new_std, 2 * std, rtol=1e-4, atol=0)


def test_every_declared_arm_fits_the_config_of_the_repo() -> None:
    for experiment in EXPERIMENTS:
        for arm in experiment.arms:
            sets = [f"{key}={json.dumps(value)}" for key, value in arm.overrides.items()]
            config = read_config(CONFIG, DyFNRunConfig, sets)
            for key, value in arm.overrides.items():
                at = config.model_dump()
                for part in key.split("."):
                    at = at[part]
                assert at == value


def test_verdict_compares_with_the_spread_of_seeds() -> None:
    base = VariantScore(0.1, 0.9, 0.3, 0.5)
    worse = replace(base, video_abs_rel=0.4)
    controls = {"clips": {"base": base, "ema": worse, "frozen": worse, "ramp": worse}}
    controls["clips"]["constant"] = worse
    values = {"ours": (0.20, 0.22), "like ours": (0.20, 0.23), "failing": ()}
    arms = {
        name: ArmScores({"clips": [replace(base, video_abs_rel=v) for v in found]})
        for name, found in values.items()
    }
    arms["failing"].failed[1] = "no finite loss"
    sentences = verdicts(controls, arms)
    assert "ours -0.090 video AbsRel against base, beyond the seeds' spread (0.014)" in sentences[0]
    assert "like ours +0.005 video AbsRel against ours, within" in sentences[1]
    assert sentences[2] == "failing, seed 1, failed: no finite loss."
    table = trained_table(controls, arms)
    assert "| **ours** | 0.100 ± 0.000 | 0.210 ± 0.014 | 0.500 ± 0.000 | 45 ± 7% |" in table
    assert "| **failing** | failed |" in table


def test_only_what_is_between_the_markers_changes(tmp_path: Path) -> None:
    path = tmp_path / "R.md"
    path.write_text("a\n<!-- experiment: x -->\nold\n<!-- end of experiment: x -->\nb\n")
    write_section(path, "x", r"new \1")
    write_section(path, "y", "other")
    assert path.read_text() == (
        "a\n<!-- experiment: x -->\nnew \\1\n<!-- end of experiment: x -->\nb\n\n## Experiments\n\n"
        "<!-- experiment: y -->\nother\n<!-- end of experiment: y -->\n"
    )
    path.write_text("<!-- experiment: x -->\n")
    with pytest.raises(ValueError, match="only one of"):
        write_section(path, "x", "new")


def test_config_of_an_earlier_version_and_its_runs_are_taken(folder: Path, tmp_path: Path) -> None:
    """What they were trained with is found again in today's form: nothing is trained twice."""
    assert run(folder, "effect", "--seeds", "1") == 0
    out = tmp_path / "out"
    shutil.copytree(folder / "out", out)
    (today,) = {
        path.parents[1]
        for path in out.glob("runs/*/seed_0/config.yaml")
        if yaml.safe_load(path.read_text())["dyfn"].get("kind", "convgru") == "convgru"
    }
    for other in set(out.glob("runs/*")) - {today}:
        shutil.rmtree(other)
    aged = today.rename(today.with_name("of-before"))
    for path in (aged / "seed_0" / "config.yaml", folder / "config.yaml"):
        values = yaml.safe_load(path.read_text())
        method = values.pop("method")
        objective = method.pop("objective")
        del method["kind"], objective["kind"]
        values |= {"stabilizer": values.pop("dyfn"), **method, **objective}
        (path if path.parent != folder else tmp_path / "config.yaml").write_text(
            yaml.safe_dump(values)
        )
    finished = (aged / "seed_0" / "results.json").stat().st_mtime_ns
    command = ["experiments", "effect", "--seeds", "1", "--stride", "2", "--out", str(out)]
    assert main([*command, "--config", str(tmp_path / "config.yaml")]) == 0
    assert (aged / "seed_0" / "results.json").stat().st_mtime_ns == finished
    assert list(out.glob("runs/*")) == [aged]


def test_default_config_is_found_from_anywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["experiments", "effect", "--base", "absent.safetensors"]) == 1
    told = capsys.readouterr().err
    assert "absent.safetensors" in told
    assert "no training config" not in told


def test_unknown_experiment_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(folder, "efect") == 1
    assert "no experiment efect; there are effect" in capsys.readouterr().err
    assert len(find_experiments([])) == len(EXPERIMENTS)
    assert main(["experiments", "--list"]) == 0
    printed = capsys.readouterr().out
    assert all(experiment.name in printed for experiment in EXPERIMENTS)
