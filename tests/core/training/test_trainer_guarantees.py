"""What a run promises: whole checkpoints, resuming bit for bit, no step that is not finite."""

from __future__ import annotations

import json
import logging
import random
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from dyfn_core.models.checkpoints import read_checkpoint
from dyfn_core.training.loop.checkpoint import (
    PREVIOUS_FILE,
    STATE_FILE,
    DamagedCheckpointError,
    read_state,
    write_state,
)
from dyfn_core.training.loop.run_folder import read_log
from dyfn_core.training.loop.run_state import moments
from dyfn_core.training.loop.trainer import InterruptedRunError, Trainer, TrainingError
from tests.support import training_toys
from tests.support.training_toys import (
    PATIENCE,
    ToyTask,
    environment,
    run_toy,
    toy_config,
    wait_for_step,
)

LONG: dict[str, Any] = {"steps": 120, "validate_every": 50, "picture_every": 1000}


def weights(out: Path) -> dict[str, torch.Tensor]:
    return read_checkpoint(out / "model.safetensors").weights


def assert_same_end(ours: Path, theirs: Path) -> None:
    """Parameters, moments, averages, counters and every logged loss agree bit for bit."""
    left, right = read_state(ours), read_state(theirs)
    for part in ("model", "optimizer", "ema"):
        assert flatten(left[part]).keys() == flatten(right[part]).keys()
        for name, value in flatten(left[part]).items():
            assert torch.equal(value, flatten(right[part])[name]), name
    for counter in ("step", "images", "best", "bad_steps", "skipped_steps"):
        assert left[counter] == right[counter]
    exported = weights(theirs)
    assert all(torch.equal(value, exported[name]) for name, value in weights(ours).items())
    assert losses(ours) == losses(theirs)


def flatten(values: object, prefix: str = "") -> dict[str, torch.Tensor]:
    if not isinstance(values, dict):
        return {prefix: torch.as_tensor(values)}
    parts = (flatten(value, f"{prefix}/{name}") for name, value in values.items())
    return {name: value for part in parts for name, value in part.items()}


def losses(out: Path) -> list[tuple[int, float]]:
    lines = read_log(out / "log.jsonl")
    return [(line["step"], line["loss"]) for line in lines if line["group"] == "train"]


def start(out: Path, resume: str = "new", **changes: object) -> subprocess.Popen[bytes]:
    command = [sys.executable, training_toys.__file__, str(out), resume, json.dumps(changes)]
    return subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE)


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run of 120 steps."""
    out = tmp_path_factory.mktemp("whole") / "run"
    torch.set_num_threads(1)
    run_toy(out, **LONG)
    return out


@pytest.mark.slow
def test_run_killed_at_a_random_moment_ends_as_an_uninterrupted_one(
    whole_run: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    moments = sorted(random.sample(range(5, 100), 2))
    for attempt, moment in enumerate(moments):
        process = start(out, "resume" if attempt else "new", **LONG)
        wait_for_step(process, out, moment)
        process.kill()
        assert process.wait() == -signal.SIGKILL
    run_toy(out, resume=True, **LONG)
    assert_same_end(out, whole_run)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_ends_a_run_with_a_checkpoint(number: signal.Signals, tmp_path: Path) -> None:
    out = tmp_path / "run"
    # As in the background of a shell, where SIGINT is ignored from the start.
    ignored = "import signal, runpy, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); "
    script = f"{ignored}sys.argv.pop(0); runpy.run_path(sys.argv[0], run_name='__main__')"
    # Without the checkpoints in between: the one at the end must be the signal's.
    changes = json.dumps({"steps": 10**6, "checkpoint_minutes": 1e3, "validate_every": 10**7})
    command = [sys.executable, "-c", script, training_toys.__file__, str(out), "new", changes]
    process = subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE)
    wait_for_step(process, out, 3)
    process.send_signal(number)
    _, complaint = process.communicate(timeout=PATIENCE)
    assert f"{number.name}: checkpoint written at step".encode() in complaint
    last = read_log(out / "log.jsonl")[-1]["step"]
    assert read_state(out)["step"] == last
    assert not (out / "results.json").exists()


def test_averaged_parameters_survive_a_resume(tmp_path: Path) -> None:
    half = tmp_path / "half"
    torch.manual_seed(1)
    Trainer(ToyTask(), toy_config(), half, resume=False).train(max_steps=3)
    resumed = Trainer(ToyTask(), toy_config(), half, resume=True)
    saved = read_state(half)["ema"]
    assert resumed.ema.updates == saved["updates"] == 3
    for name, average in resumed.ema.averages.items():
        assert torch.equal(average, saved["averages"][name])
        assert not torch.equal(average, resumed.ema.parameters[name])
    resumed.train()
    whole = run_toy(tmp_path / "whole")
    for name, average in whole.ema.averages.items():
        assert torch.equal(average, resumed.ema.averages[name])


def test_only_dyfn_has_gradients_and_the_clip_norm_sees_nothing_else(tmp_path: Path) -> None:
    task = ToyTask()
    task.model.unit.requires_grad_(True)  # as a frozen part that somebody forgot to freeze
    trainer = Trainer(task, toy_config(clip_norm=1e9), tmp_path / "run", resume=False)
    trainer.train(max_steps=1)
    dyfn = [p.grad for p in task.model.stabilizer.parameters() if p.grad is not None]
    norm = torch.stack([gradient.norm() for gradient in dyfn]).norm()
    logged = read_log(tmp_path / "run" / "log.jsonl")[0]["gradient_norm"]
    assert task.model.unit.grad is not None
    assert float(task.model.unit.grad.norm()) > 0.01
    assert logged == pytest.approx(float(norm), rel=1e-6)


def test_step_that_is_not_finite_changes_nothing_and_is_counted(tmp_path: Path) -> None:
    torch.manual_seed(1)
    trainer = Trainer(ToyTask(poison=(2, 3)), toy_config(), tmp_path / "run", resume=False)
    before, after = {}, {}
    step = trainer._step

    def watched(*arguments):  # type: ignore[no-untyped-def]
        index = trainer.step
        before[index] = snapshot(trainer)
        result = step(*arguments)
        after[index] = snapshot(trainer)
        return result

    trainer._step = watched  # type: ignore[method-assign]
    trainer.train()
    for index in range(6):
        same = all(torch.equal(v, after[index][k]) for k, v in before[index].items())
        assert same == (index in (2, 3))
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert (results["skipped_steps"], results["step"]) == (2, 6)
    assert read_state(tmp_path / "run")["skipped_steps"] == 2


def snapshot(trainer: Trainer) -> dict[str, torch.Tensor]:
    parts = {
        "model": trainer.task.model.state_dict(),
        "moments": moments(trainer.task.model, trainer.optimizer),
    }
    parts["ema"] = trainer.ema.averages
    return {name: value.clone() for name, value in flatten(parts).items()}


def test_too_many_steps_that_are_not_finite_end_the_run_with_the_reason(tmp_path: Path) -> None:
    task = ToyTask(poison=tuple(range(1, 9)))
    trainer = Trainer(task, toy_config(steps=9, most_bad_steps=3), tmp_path / "run", False)
    with pytest.raises(TrainingError, match="no finite loss or gradient in 4 steps up to step 5"):
        trainer.train()
    state = read_state(tmp_path / "run")
    assert all(value.isfinite().all() for value in state["model"].values())


@pytest.fixture
def two_states(tmp_path: Path) -> Path:
    """A folder with state.pt of step 2 and the previous one of step 1."""
    for step in (1, 2):
        write_state(tmp_path, {"step": step, "model": {"w": torch.full((500,), float(step))}})
    return tmp_path


@pytest.mark.parametrize("damage", ["cut", "byte", "absent", "empty", "other"])
def test_damaged_state_gives_way_to_the_previous_one_and_says_so(
    two_states: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = two_states / STATE_FILE
    content = bytearray(path.read_bytes())
    middle = content.index(torch.full((8,), 2.0).numpy().tobytes())
    content[middle + 5] ^= 0x10
    if damage == "absent":
        path.unlink()
    else:
        kinds = {"cut": content[: len(content) // 2], "byte": content, "empty": b""}
        path.write_bytes(kinds.get(damage, b"no checkpoint at all"))
    with caplog.at_level(logging.WARNING):
        state = read_state(two_states)
    assert state["step"] == 1
    assert torch.equal(state["model"]["w"], torch.ones(500))
    reason = "is missing" if damage == "absent" else "is damaged"
    assert f"{STATE_FILE} {reason}" in caplog.text
    assert f"{PREVIOUS_FILE} (step 1)" in caplog.text


def test_no_flipped_bit_of_a_state_goes_unseen(two_states: Path) -> None:
    path = two_states / STATE_FILE
    whole = path.read_bytes()
    draw = random.Random(0)
    for _ in range(60):
        content = bytearray(whole)
        content[draw.randrange(len(whole))] ^= 1 << draw.randrange(8)
        path.write_bytes(content)
        state = read_state(two_states)
        value = float(state["step"])  # what is loaded is one of the two states, whole
        assert torch.equal(state["model"]["w"], torch.full((500,), value))


def test_two_damaged_states_are_an_error_that_names_both(two_states: Path) -> None:
    for name in (STATE_FILE, PREVIOUS_FILE):
        (two_states / name).write_bytes(b"PK\x03\x04 cut short")
    with pytest.raises(DamagedCheckpointError, match=r"state.pt is damaged.*state.previous.pt is"):
        read_state(two_states)
    with pytest.raises(TrainingError, match=r"state.pt is damaged"):
        Trainer(ToyTask(), toy_config(), two_states, resume=True)


def test_half_written_state_is_never_loaded_nor_kept(two_states: Path) -> None:
    half = two_states / f".{STATE_FILE}.12345.partial"
    half.write_bytes(b"half")
    assert read_state(two_states)["step"] == 2
    write_state(two_states, {"step": 3})
    assert not half.exists()
    steps = [torch.load(two_states / name)["step"] for name in (STATE_FILE, PREVIOUS_FILE)]
    assert steps == [3, 2]


def test_full_disk_leaves_the_old_state(two_states: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space"):
        write_state(two_states, {"step": 3})
    assert read_state(two_states)["step"] == 2
    assert not list(two_states.glob("*.partial")) + list(two_states.glob(".*.partial"))


def test_run_folder_tells_settings_versions_and_results(tmp_path: Path) -> None:
    out = tmp_path / "run"
    run_toy(out)
    assert yaml.safe_load((out / "config.yaml").read_text()) == toy_config().model_dump(mode="json")
    versions = json.loads((out / "versions.json").read_text())
    assert versions["packages"]["torch"] == torch.__version__
    assert versions["processes"] == 1
    assert versions["machine"]["logical_cores"] >= 1
    assert str(Path.home()) not in (out / "versions.json").read_text()
    results = json.loads((out / "results.json").read_text())
    assert results["step"] == 6
    assert results["images"] == 24
    assert results["best"] <= results["score"]


def test_log_lines_beyond_the_checkpoint_are_dropped(tmp_path: Path) -> None:
    out = tmp_path / "run"
    Trainer(ToyTask(), toy_config(), out, resume=False).train(max_steps=3)
    with (out / "log.jsonl").open("a") as log:
        log.write('{"step": 4, "group": "train", "loss": 9.0}\n{"step": 5, "gro')
    Trainer(ToyTask(), toy_config(), out, resume=True).train()
    assert [step for step, _ in losses(out)] == [1, 2, 3, 4, 5, 6]


def test_signal_before_the_loop_is_over_is_an_interrupted_run(tmp_path: Path) -> None:
    task = ToyTask()
    trainer = Trainer(task, toy_config(checkpoint_minutes=1e3), tmp_path / "run", resume=False)
    images = task.images

    def interrupting(batch):  # type: ignore[no-untyped-def]
        if trainer.step == 3:
            signal.raise_signal(signal.SIGTERM)
        return images(batch)

    task.images = interrupting  # type: ignore[method-assign]
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(InterruptedRunError, match="SIGTERM: checkpoint written at step 4"):
        trainer.train()
    assert signal.getsignal(signal.SIGTERM) is before
    assert read_state(tmp_path / "run")["step"] == 4


def test_patience_ends_a_run_in_which_nothing_gets_better(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The best of the scores is the second; two more validations end it, also after a resume."""
    scores = iter([3.0, 2.0, 2.5, 2.0, 1.0])
    monkeypatch.setattr(ToyTask, "validate", lambda self: {"score": next(scores)})
    changes: dict[str, Any] = {"steps": 100, "validate_every": 3, "patience": 2}
    config = toy_config(**changes)
    first = Trainer(ToyTask(), config, tmp_path / "run", resume=False)
    first.train(max_steps=8)  # which validates at 3, 6, and 8
    assert (first.step, first.stale) == (8, 1)
    assert not (tmp_path / "run" / "results.json").exists()
    trainer = run_toy(tmp_path / "run", resume=True, **changes)
    assert (trainer.step, trainer.best, trainer.stale) == (9, 2.0, 2)
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert (results["step"], results["best"]) == (9, 2.0)
