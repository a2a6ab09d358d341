"""Several processes are one run: same gradients, same parameters, one writer."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections import Counter
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from safetensors.torch import save_file

from dyfn_core.cli import train
from dyfn_core.models.checkpoints import read_checkpoint
from dyfn_core.training.config import ConfigError
from dyfn_core.training.loop.checkpoint import read_state
from dyfn_core.training.loop.processes import Processes
from dyfn_core.training.loop.run_folder import read_log
from dyfn_core.training.tasks import latent_cache as latents
from dyfn_core.training.tasks.latent_cache import CacheFolder
from tests.support import training_toys
from tests.support.training_toys import (
    PATIENCE,
    ToyTask,
    environment,
    run_toy,
    tiny_base,
    tiny_dyfn_settings,
    toy_config,
)

TOLERANCE = 2e-6  # float32 sums in another order, after six steps of AdamW at 1e-2


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def run_two(arguments: list[str]) -> None:
    """The same command in two processes, joined over the loopback interface as torchrun does."""
    shared = {
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(free_port()),
        "GLOO_SOCKET_IFNAME": "lo",
        "WORLD_SIZE": "2",
        "LOCAL_WORLD_SIZE": "2",
    }
    processes = [
        subprocess.Popen(
            [sys.executable, *arguments],
            env={**environment(), **shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        for rank in range(2)
    ]
    try:
        complaints = [process.communicate(timeout=PATIENCE)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert [process.returncode for process in processes] == [0, 0], complaints


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A toy run of two processes with half of every batch each."""
    out = tmp_path_factory.mktemp("two") / "run"
    run_two([training_toys.__file__, str(out), "new", json.dumps({"clip_norm": 0.01})])
    return out


@pytest.mark.slow
@pytest.mark.parametrize("parts", [1, 2])
def test_two_processes_train_as_one_with_the_whole_batch(
    two: Path, parts: int, tmp_path: Path
) -> None:
    one = tmp_path / "one"
    torch.set_num_threads(1)
    run_toy(one, parts=parts, clip_norm=0.01)
    ours = read_checkpoint(two / "model.safetensors").weights
    start = ToyTask().model.state_dict()
    for name, value in read_checkpoint(one / "model.safetensors").weights.items():
        torch.testing.assert_close(ours[name], value, rtol=0, atol=TOLERANCE)
        assert name == "unit" or (value - start[name]).abs().max() > 100 * TOLERANCE
    norms = [
        [line["gradient_norm"] for line in read_log(out / "log.jsonl") if "gradient_norm" in line]
        for out in (two, one)
    ]
    assert norms[0] == pytest.approx(norms[1], rel=1e-5)


def test_only_the_main_process_writes(two: Path) -> None:
    steps = [line["step"] for line in read_log(two / "log.jsonl") if line["group"] == "train"]
    assert steps == [1, 2, 3, 4, 5, 6]
    assert len(list((two / "tensorboard").iterdir())) == 1
    assert json.loads((two / "versions.json").read_text())["processes"] == 2
    assert read_state(two)["images"] == 24


def test_parts_that_cannot_be_shared_out_are_refused() -> None:
    with pytest.raises(ConfigError, match="cannot be split into 3 equal parts"):
        next(ToyTask().batches(0, 0, 3))
    processes = Processes(toy_config(parts=3))
    assert list(processes.own_parts) == [0, 1, 2]


def test_processes_make_a_cache_together(tmp_path: Path) -> None:
    tiny_base(tmp_path)
    settings = tiny_dyfn_settings(tmp_path)
    settings["method"] |= {"cache_draws": 5, "clips": 2}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings))
    command = ["dyfn", str(tmp_path / "config.yaml"), "--out"]
    run_two(["-m", "dyfn_core.cli.train", *command, str(tmp_path / "two")])
    assert train.main([*command, str(tmp_path / "one")]) == 0
    files = {path.name: path for path in (tmp_path / "one" / "latents").iterdir()}
    assert len(files) == 6
    for path in (tmp_path / "two" / "latents").iterdir():
        assert path.read_bytes() == files.pop(path.name).read_bytes()
    assert not files


def test_a_process_makes_its_share_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three, the second: what it has not made when all are done is missing on its disk."""
    made: list[int] = []
    folder = CacheFolder(tmp_path, 7, {}, "toys")
    monkeypatch.setattr(latents, "batch_loader", lambda source, start, unreadable: count(start))
    monkeypatch.setattr(latents, "own_place", lambda: (1, 3))

    def all_here() -> None:
        assert made == [2, 3]
        for index in (0, 1, 4):
            save_file({"number": torch.tensor(index)}, tmp_path / f"{index:05d}.safetensors")

    def make(batch: Any) -> dict[str, torch.Tensor]:
        made.append(batch)
        return {"number": torch.tensor(batch)}

    monkeypatch.setattr(latents, "wait_for_every_process", all_here)
    folder.build(None, make, Counter())  # type: ignore[arg-type]
    assert made == [2, 3, 5, 6]
    assert [int(entry["number"]) for entry in folder.load()] == list(range(7))
