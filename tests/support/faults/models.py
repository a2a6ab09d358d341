"""Models and devices that are not there, or are not what they should be."""

from __future__ import annotations

import os
import pickle
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from tests.support.faults.bench import RAW, Bench, faulty_bench
from tests.support.faults.fault import Fault
from tests.support.faults.requests import change, state

Make = Callable[[Path], object]
MINI = files("dyfn_core") / "weights" / "dyfn-mini.safetensors"


class Evil:
    """A pickle that makes a file when it is opened."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (os.environ["DYFN_EVIL"],)


@contextmanager
def model_bench(domain: dict[str, str]) -> Iterator[Bench]:
    with faulty_bench(domain, (RAW,)) as bench:
        yield bench


def not_configured(bench: Bench, **parameters: str) -> str:
    """Back to unconfigured; with what was there before it can be configured."""
    before = {name: getattr(bench.node.settings, name) for name in parameters}
    for label in ("deactivate", "cleanup"):
        assert change(bench, label=label)
    for name, value in parameters.items():
        assert bench.set(name, value)
    assert not change(bench, label="configure")
    assert state(bench) == "unconfigured"
    for name, value in before.items():
        assert bench.set(name, value)
    for label in ("configure", "activate"):
        assert change(bench, label=label)
    return "stays unconfigured"


def refused(name: str, says: str, make: Make, file: str = "m.safetensors") -> Fault:
    def do(bench: Bench) -> str:
        with tempfile.TemporaryDirectory() as folder:
            os.environ["DYFN_EVIL"] = f"{folder}/evil"
            path = Path(folder) / file
            make(path)
            found = not_configured(bench, model=str(path))
            assert not Path(folder, "evil").exists(), "code of the file was run"
            return found

    return Fault(name, do, (f"ERROR cannot configure: .*{says}",), True, within=5)


def without_device(name: str, says: str, device: str) -> Fault:
    def do(bench: Bench) -> str:
        return not_configured(bench, device=device)

    return Fault(name, do, (f"ERROR cannot configure: .*{says}",), True, within=5)


def evil_torch(path: Path) -> None:
    torch.save({"model": Evil()}, path)


def one_nan(path: Path) -> None:
    with safe_open(str(MINI), "pt") as opened:
        tensors = {key: opened.get_tensor(key) for key in opened.keys()}  # noqa: SIM118
        metadata = opened.metadata()
    next(iter(tensors.values())).view(-1)[0] = float("nan")
    save_file(tensors, path, metadata)


def cut(path: Path) -> None:
    path.write_bytes(MINI.read_bytes()[:-1000])


def nothing(path: Path) -> None:
    pass


def evil_pickle(path: Path) -> None:
    path.write_bytes(pickle.dumps(Evil()))


def garbage(path: Path) -> None:
    path.write_bytes(os.urandom(5000))


UNKNOWN = "is no checkpoint of a known format"
FAULTS = (
    refused("a model that is not there", "no file of that path, no bundled model", nothing),
    refused("an empty file", "m.safetensors is empty", Path.touch),
    refused("a model that is cut", "is a damaged safetensors file", cut),
    refused("random bytes", UNKNOWN, garbage),
    refused("a folder without a model", "no checkpoint file at", Path.mkdir, "folder"),
    refused("a pickle with code in it", UNKNOWN, evil_pickle, "m.pt"),
    refused("a torch file with code in it", UNKNOWN, evil_torch, "m.pt"),
    refused("a model with one NaN", "does not fit its model config:.*not finite", one_nan),
    without_device("a GPU that is not there", "no device 'cuda:99' here", "cuda:99"),
    without_device("a device of another name", "device 'banana' is unknown", "banana"),
)
