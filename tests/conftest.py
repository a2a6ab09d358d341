"""Fixtures that every test may use."""

import os
from pathlib import Path

import pytest
import torch

THREADS = torch.get_num_threads()


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of golden files and real recordings, which not every machine has."""
    default = Path(__file__).resolve().parents[2] / "shared"
    path = Path(os.environ.get("DYFN_SHARED", default))
    if not path.is_dir():
        pytest.skip(f"{path} is absent: set DYFN_SHARED to the folder of golden files")
    return path


@pytest.fixture(autouse=True)
def same_threads() -> None:
    """Training sets the process's thread count, and the last bits of a gradient depend on it."""
    torch.set_num_threads(THREADS)
