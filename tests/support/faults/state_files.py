"""State files that are none, that are forged, or that are where they must not be."""

from __future__ import annotations

import os
import pickle
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from std_srvs.srv import Trigger

from tests.support.faults.bench import RAW, Bench, faulty_bench
from tests.support.faults.fault import Fault
from tests.support.forged_state import forge, forge_deep, hidden_of

NAME = "state.safetensors"
LARGE = 1_500_000_000  # bytes
Make = Callable[[Path], object]


@contextmanager
def state_bench(domain: dict[str, str]) -> Iterator[Bench]:
    """One camera, and a folder of its own for its states."""
    with (
        tempfile.TemporaryDirectory() as folder,
        faulty_bench(domain, (RAW,), state_file=str(Path(folder) / NAME)) as bench,
    ):
        yield bench


def folder_of(bench: Bench) -> Path:
    return Path(bench.node._state_folder)


def ask(bench: Bench, action: str, path: Path) -> bool:
    """-> whether the node has saved or loaded it."""
    assert bench.set("state_file", str(path))
    found = bench.ask(Trigger, action, Trigger.Request()).success
    assert bench.set("state_file", str(folder_of(bench) / NAME))
    return bool(found)


def not_loaded(make: Make, name: str = NAME) -> Callable[[Bench], str]:
    """A file made by `make` is not loaded, and the stream goes on without a reset."""

    def do(bench: Bench) -> str:
        path, resets = folder_of(bench) / name, dict(bench.node._cameras[0].resets)
        make(path)
        assert not ask(bench, "load_state", path)
        bench.recover(RAW)
        assert bench.node._cameras[0].resets == resets
        if path.is_file():
            path.unlink()
        return "not loaded, no reset"

    return do


def not_replaced(make: Make, name: str) -> Callable[[Bench], str]:
    """What is there already is not replaced, and nothing is left beside it."""

    def do(bench: Bench) -> str:
        path = folder_of(bench) / name
        make(path)
        before = {one: os.lstat(one).st_ino for one in folder_of(bench).iterdir()}
        assert not ask(bench, "save_state", path)
        assert {one: os.lstat(one).st_ino for one in folder_of(bench).iterdir()} == before
        return "nothing is written"

    return do


def save(bench: Bench, path: Path) -> None:
    assert ask(bench, "save_state", path)


def changed(change: Callable[[bytes], bytes]) -> Callable[[Bench], str]:
    """A state that the node has saved, with other bytes."""

    def do(bench: Bench) -> str:
        path = folder_of(bench) / NAME
        save(bench, path)
        data = change(path.read_bytes())
        return not_loaded(lambda one: one.write_bytes(data))(bench)

    return do


def forged(change: Callable[[Path], None]) -> Callable[[Bench], str]:
    """The same, with a digest that fits."""

    def do(bench: Bench) -> str:
        path = folder_of(bench) / NAME
        save(bench, path)
        change(path)
        return not_loaded(lambda one: None)(bench)

    return do


def other_shapes(bench: Bench) -> str:
    """Loaded, since only the network can tell: it fails on one picture, and begins anew."""
    path = folder_of(bench) / NAME
    save(bench, path)

    def change(content: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
        tensors[hidden_of(content)] = torch.zeros(1, 3, 2, 2)

    forge(path, change)
    assert ask(bench, "load_state", path)
    return "loaded; the first picture has no depth"


def nan(content: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
    tensors[hidden_of(content)][:] = float("nan")


def flip(data: bytes) -> bytes:
    return data[:-9] + bytes([data[-9] ^ 1]) + data[-8:]


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(LARGE)


def another_model(path: Path) -> None:
    path.write_bytes((files("dyfn_core") / "weights" / "dyfn-mini.safetensors").read_bytes())


def text(path: Path) -> None:
    path.write_text("of somebody else")


def text_beside(path: Path) -> None:
    """A link to a file of somebody else, in the folder."""
    text(path.with_name("theirs"))
    path.symlink_to("theirs")


def outside(path: Path) -> None:
    """A link that leads out of the folder."""
    path.symlink_to("/dev/full")


def rows() -> tuple[Fault, ...]:
    def load(name: str, says: str, do: Callable[[Bench], str]) -> Fault:
        return Fault(f"load {name}", do, (f"ERROR load_state: .*{says}",), True)

    def to(name: str, says: str, make: Make, file: str) -> Fault:
        do = not_replaced(make, file)
        return Fault(f"save to {name}", do, (f"ERROR save_state: .*{says}",), True)

    def nothing(path: Path) -> None:
        pass

    damaged = "is damaged, or no state file"
    return (
        load("a file that is not there", "No such file or directory", not_loaded(nothing, "no")),
        load("an empty file", damaged, not_loaded(Path.touch)),
        load("a state that is cut", damaged, changed(lambda data: data[:-100])),
        load("a state with a flipped bit", "its content does not fit its digest", changed(flip)),
        load(
            "random bytes, a pickle",
            damaged,
            not_loaded(lambda path: path.write_bytes(pickle.dumps([os.getcwd]) + os.urandom(999))),
        ),
        load(
            "a file whose header says 2⁶³ bytes",
            damaged,
            not_loaded(lambda path: path.write_bytes(b"\xff" * 7 + b"\x7f" + b"{}")),
        ),
        load("a model", "has format '.*', expected a stream state", not_loaded(another_model)),
        load(
            "a forged state of NaN",
            "DyFN's hidden state is not finite",
            forged(lambda path: forge(path, nan)),
        ),
        load(
            "a forged description, 100 000 deep",
            "the description of the state is bad: .*",
            forged(forge_deep),
        ),
        Fault(
            "load a forged state of other shapes",
            other_shapes,
            ("ERROR .*inference failed, the stream resets",),
            within=2,
        ),
        load(
            "1.5 GB",
            "has 1500000000 bytes, a state has at most 268435456",
            not_loaded(sparse),
        ),
        load("a pipe", "is no regular file", not_loaded(os.mkfifo, "pipe")),
        load("a folder", "is no regular file|Is a directory", not_loaded(Path.mkdir, "folder")),
        load("a device through a link", "is outside of the folder", not_loaded(outside, "out")),
        to("a file of somebody else", "is no state file, it is not replaced", text, "text"),
        to("a link", "is no regular file, it is not replaced", text_beside, "link"),
        to("a pipe, nobody reads it", "is no regular file", os.mkfifo, "pipe2"),
        to("a device through a link", "is outside of the folder", outside, "out2"),
        to("a folder that is not there", "No such file or directory", nothing, "no/state"),
        to("a name of 300 characters", "File name too long", nothing, "n" * 300),
        to("another folder", "is outside of the folder for state files", nothing, "../state"),
        to("/proc", "is outside of the folder for state files", nothing, "/proc/state"),
    )


FAULTS = rows()
