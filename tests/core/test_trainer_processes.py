"""Several processes are one run: same gradients, same parameters, one writer."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import training_toys
from training_toys import PATIENCE, ToyTask, environment, run_toy, toy_config

from dyfn_core.models.checkpoints import read_checkpoint
from dyfn_core.training.checkpoint import read_state
from dyfn_core.training.config import ConfigError
from dyfn_core.training.processes import Processes
from dyfn_core.training.run_folder import read_log

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
