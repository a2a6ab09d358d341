"""Fixtures that every test may use."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of golden files and real recordings, which not every machine has."""
    default = Path(__file__).resolve().parents[2] / "shared"
    path = Path(os.environ.get("DYFN_SHARED", default))
    if not path.is_dir():
        pytest.skip(f"{path} is absent: set DYFN_SHARED to the folder of golden files")
    return path
