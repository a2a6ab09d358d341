"""The state of a run on disk: state.pt, whole or not at all, with the one before it kept."""

from __future__ import annotations

import logging
import zipfile
from pathlib import Path
from typing import Any

import torch

from dyfn_core.files import finished_file

STATE_FILE = "state.pt"
PREVIOUS_FILE = "state.previous.pt"

logger = logging.getLogger(__name__)


class DamagedCheckpointError(ValueError):
    """A state file that is not what was written; the message names the file and the damage."""


def has_state(folder: Path) -> bool:
    """Whether a run has left a checkpoint in the folder."""
    return any((folder / name).exists() for name in (STATE_FILE, PREVIOUS_FILE))


def write_state(folder: Path, state: dict[str, Any]) -> None:
    """Write state.pt; the one that was there becomes state.previous.pt.

    At every moment at least one of the two is whole. Raises OSError, the old files untouched,
    when the disk does not take it.
    """
    current = folder / STATE_FILE
    for stale in folder.glob(f".{STATE_FILE}.*.partial"):  # of a process that was killed
        stale.unlink()
    with finished_file(current, durable=True, previous=folder / PREVIOUS_FILE) as partial:
        torch.save(state, partial)


def read_state(folder: Path) -> dict[str, Any]:
    """The newest whole state in a folder; a damaged or missing newest one is named in a warning.

    Raises FileNotFoundError when there is none, DamagedCheckpointError when none is whole.
    """
    if not has_state(folder):
        raise FileNotFoundError(f"nothing to resume: no {folder / STATE_FILE}")
    problems = []
    for name in (STATE_FILE, PREVIOUS_FILE):
        path = folder / name
        try:
            state = _read_verified(path)
        except (DamagedCheckpointError, FileNotFoundError) as error:
            problems.append(str(error))
            continue
        if problems:
            logger.warning("%s; going on from %s (step %d)", problems[0], path, state["step"])
        return state
    raise DamagedCheckpointError("; ".join(problems))


def _read_verified(path: Path) -> dict[str, Any]:
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing")
    try:
        # torch.load does not look at the checksums that the archive has for every record.
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise DamagedCheckpointError(f"{path} is damaged: bad checksum of {damaged}")
        state = torch.load(path, map_location="cpu", weights_only=True)
    except DamagedCheckpointError:
        raise
    except Exception as error:  # whatever broken bytes make zip and pickle readers raise
        reason = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
        raise DamagedCheckpointError(f"{path} is damaged: {reason}") from error
    if not isinstance(state, dict) or "step" not in state:
        raise DamagedCheckpointError(f"{path} holds no state of a training run")
    return state
