"""The files of a run beside its checkpoints: settings, versions, log, curves, results."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml
from torch.utils.tensorboard import SummaryWriter

from dyfn_core.files import write_text
from dyfn_core.training.config import LoopConfig

CONFIG_FILE = "config.yaml"
VERSIONS_FILE = "versions.json"
RESULTS_FILE = "results.json"
LOG_FILE = "log.jsonl"
PACKAGES = (
    "dyfn_ros",
    "torch",
    "numpy",
    "opencv-python-headless",
    "safetensors",
    "pydantic",
    "accelerate",
    "tensorboard",
)


class RunFolder:
    """Writes a run's log.jsonl, TensorBoard events, pictures, settings and results.

    step: what the run goes on from. Log lines beyond it come from a run that was killed after
    its last checkpoint; they will be written anew and are dropped.
    """

    def __init__(self, folder: Path, config: LoopConfig, step: int, facts: dict[str, Any]) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        (folder / RESULTS_FILE).unlink(missing_ok=True)
        settings = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)
        write_text(folder / CONFIG_FILE, settings)
        write_text(folder / VERSIONS_FILE, json.dumps({**versions(), **facts}, indent=1) + "\n")
        self._drop_lines_after(step)
        self.writer = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def _drop_lines_after(self, step: int) -> None:
        path = self.folder / LOG_FILE
        if path.exists():
            kept = [line for line in read_log(path) if line["step"] <= step]
            write_text(path, "".join(json.dumps(line) + "\n" for line in kept))

    def log(self, group: str, step: int, values: dict[str, float], **more: float) -> None:
        """One line of log.jsonl and one point of each curve "group/name"."""
        for name, value in values.items():
            self.writer.add_scalar(f"{group}/{name}", value, step)
        line = {"step": step, **more, "group": group, **values}
        with (self.folder / LOG_FILE).open("a") as log:
            log.write(json.dumps(line) + "\n")

    def picture(self, step: int, strip: np.ndarray) -> None:
        """strip: H x W x 3 uint8 RGB, to TensorBoard and pictures/."""
        self.writer.add_image("strip", strip, step, dataformats="HWC")
        folder = self.folder / "pictures"
        folder.mkdir(exist_ok=True)
        cv2.imwrite(str(folder / f"{step:07d}.jpg"), strip[..., ::-1])

    def results(self, values: dict[str, Any]) -> None:
        """results.json: there when, and only when, the run is over."""
        finite = {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in values.items()
        }
        write_text(self.folder / RESULTS_FILE, json.dumps(finite, indent=1) + "\n")

    def close(self) -> None:
        """Flush the curves."""
        self.writer.close()


def read_log(path: Path) -> list[dict[str, Any]]:
    """The whole lines of a log.jsonl; one that a kill cut short, which is the last, is left out.

    Raises ValueError naming the line when another one is damaged.
    """
    lines = path.read_text().splitlines()
    found = []
    for number, line in enumerate(lines, 1):
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError as error:
            if number < len(lines):
                raise ValueError(f"{path}, line {number}: no JSON: {error}") from error
    return found


def versions() -> dict[str, Any]:
    """Python, packages, git commit if there is one, and what the machine is; no paths."""
    return {
        "python": platform.python_version(),
        "packages": {name: found for name in PACKAGES if (found := _package(name)) is not None},
        "git": _git_commit(),
        "machine": {
            "system": platform.system(),
            "release": platform.release(),
            "architecture": platform.machine(),
            "processor": _processor(),
            "logical_cores": os.cpu_count(),
            "memory_gb": _memory_gb(),
            "gpus": [
                torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())
            ],
        },
    }


def _package(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _git_commit() -> str | None:
    """The commit that the code is at, "+ changes" when it differs from it."""
    here = Path(__file__).parent
    found = []
    for command in (["rev-parse", "HEAD"], ["status", "--porcelain", "--", "."]):
        try:
            done = subprocess.run(
                ["git", *command], cwd=here, capture_output=True, text=True, timeout=20, check=True
            )
        except (OSError, subprocess.SubprocessError):
            return None
        found.append(done.stdout.strip())
    commit, changes = found
    return f"{commit} + changes" if changes else commit


def _processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _memory_gb() -> float | None:
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None
    return round(size / 2**30, 1)
