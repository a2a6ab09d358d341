"""benchmarks/gpu_train.py: its commands are valid, its seeds apart, its limits kept."""

from __future__ import annotations

import argparse
import sys
import zipfile
from pathlib import Path

import pytest

from benchmarks import gpu_train
from dyfn_core.training.config import BaseRunConfig, read_config
from dyfn_core.training.dyfn_config import DyFNRunConfig, LinearizedMethod
from dyfn_worlds.cli import parser as worlds_parser


def options(tmp_path: Path, *more: str) -> argparse.Namespace:
    given = ["--art", str(tmp_path / "art"), "--workers", "3", "--part", "4", *more]
    return gpu_train.parsed(given)


def overrides(command: list[str]) -> list[str]:
    return [word.removeprefix("--set=") for word in command if word.startswith("--set=")]


def test_the_base_goes_on_in_bf16_from_the_data_that_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "data/rooms_usual").mkdir(parents=True)
    command = gpu_train.base_command(options(tmp_path), tmp_path, 252.0)
    config = read_config(Path(command[4]), BaseRunConfig, overrides(command))
    assert [data.root for data in config.data] == [tmp_path / "data/rooms_usual"]
    assert config.data[0].weight == pytest.approx(0.4)
    assert (config.mixed_precision, config.parts, config.stages[0].batch) == ("bf16", 3, 12)
    assert config.hours == pytest.approx(0.07)
    assert "tum_fr1_rpy" in capsys.readouterr().out


def test_nothing_to_train_on_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "data/real/held").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match="none of the data sets"):
        gpu_train.base_command(options(tmp_path), tmp_path, 60.0)


def test_dyfn_learns_from_walks_alone_with_one_cache(tmp_path: Path) -> None:
    unfinished = tmp_path / "data/clips_maps/clips/one"
    unfinished.mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match="no walk was finished"):
        gpu_train.dyfn_command(options(tmp_path), tmp_path, Path("moved"), "dyfn", 50, 20)
    for folder in ("clips_rooms/clips/one", "rooms_usual/frames/one", "base_walks_rooms/clips/one"):
        (tmp_path / "data" / folder).mkdir(parents=True)
        (tmp_path / "data" / folder / "meta.json").touch()
    command = gpu_train.dyfn_command(
        options(tmp_path, "--device", "cpu"), tmp_path, Path("moved.safetensors"), "dyfn", 50, 20
    )
    config = read_config(Path(command[4]), DyFNRunConfig, overrides(command))
    assert [data.root for data in config.data] == [tmp_path / "data/clips_rooms"]
    assert isinstance(config.method, LinearizedMethod)
    assert config.method.gru_input_draws == 50
    assert config.method.cache == tmp_path / "gru_inputs"
    assert config.device == "cpu"


@pytest.mark.parametrize("workers", [2, 5, 40])
def test_every_renderer_has_seeds_of_its_own(tmp_path: Path, workers: int) -> None:
    with zipfile.ZipFile(tmp_path / "maps.pk3", "w") as archive:
        archive.writestr("maps/one.bsp", "")
    commands = gpu_train.renderers(tmp_path, tmp_path / "data", workers, 4)
    seen = [worlds_parser().parse_args(command[3:]) for command in commands]
    assert len({job.seed for job in seen}) == workers
    assert {job.seed % 10 for job in seen} == {1}
    assert any(job.clip_frames for job in seen) or workers == 2
    without = gpu_train.renderers(tmp_path / "empty", tmp_path / "data", workers, 4)
    assert all(worlds_parser().parse_args(c[3:]).worlds == "rooms" for c in without)


def test_more_than_may_be_carried_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "picture.jpg").write_bytes(bytes(3_000_000))
    code = gpu_train.check_size([], [])
    assert 0.5e6 < code < 20e6
    monkeypatch.setattr(gpu_train, "BUDGET", code + 2e6)
    with pytest.raises(ValueError, match=r"pack less art .*--megabytes"):
        gpu_train.check_size([], [tmp_path])
    with pytest.raises(ValueError, match="MB to carry"):
        gpu_train.check_size([gpu_train.START], [])


def test_a_renderer_that_fails_is_told_with_its_log(tmp_path: Path) -> None:
    fails = [sys.executable, "-c", "import sys; sys.exit('no context')"]
    sleeps = [sys.executable, "-c", "import time\ntry: time.sleep(60)\nexcept KeyboardInterrupt: 1"]
    with pytest.raises(RuntimeError, match="no context"):
        gpu_train.render([sleeps, fails], 30.0, tmp_path)


def test_the_number_of_clips_follows_from_the_speed_of_the_first() -> None:
    assert gpu_train.more_draws(10.0, 90.0, 3000) == 233
    assert gpu_train.more_draws(0.1, 90.0, 3000) == 3000
    assert gpu_train.more_draws(100.0, -5.0, 3000) == gpu_train.FIRST_DRAWS
