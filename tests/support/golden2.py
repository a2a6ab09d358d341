"""Golden files of MoGe v2 and Depth Anything 3: weights made from names, outputs, pictures."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor


@dataclass(frozen=True)
class Golden2:
    """The folder shared/golden2."""

    folder: Path

    def spec(self, name: str) -> dict[str, Any]:
        """What NAME.keys.json says: keys with shapes, and the configuration."""
        found: dict[str, Any] = json.loads((self.folder / f"{name}.keys.json").read_text())
        return found

    def weights(self, name: str) -> dict[str, Tensor]:
        path = self.folder / "make_weights.py"
        described = importlib.util.spec_from_file_location("make_weights", path)
        assert described is not None
        assert described.loader is not None
        module = importlib.util.module_from_spec(described)
        described.loader.exec_module(module)
        made: dict[str, Tensor] = module.make_weights(self.spec(name)["keys"])
        return made

    def moge_file(self, name: str, path: Path, changed: dict[str, Any] | None = None) -> Path:
        """A file in the official format. changed: entries of model_config."""
        config = {**self.spec(name)["model_config"], **(changed or {})}
        torch.save({"model_config": config, "model": self.weights(name)}, path)
        return path

    def da3_file(self, name: str, folder: Path, said: dict[str, Any] | None) -> Path:
        """model.safetensors in a folder, beside a config.json that says something."""
        folder.mkdir(parents=True, exist_ok=True)
        save_file(self.weights(name), folder / "model.safetensors")
        if said is not None:
            (folder / "config.json").write_text(json.dumps(said))
        return folder / "model.safetensors"

    def arrays(self, name: str, case: str) -> dict[str, np.ndarray]:
        """Arrays of NAME.npz whose names begin with `case` and a dot, without that."""
        with np.load(self.folder / f"{name}.npz") as found:
            start = f"{case}."
            return {k[len(start) :]: found[k] for k in found.files if k.startswith(start)}

    def frame(self, index: int, size: tuple[int, int] = (240, 320)) -> np.ndarray:
        """The upper left H x W of a frame, uint8 RGB."""
        with np.load(self.folder.parent / "golden" / "video_320x240.npz") as video:
            return np.ascontiguousarray(video["frames"][index][: size[0], : size[1]])


def batch_of(*images: np.ndarray) -> Tensor:
    """B x 3 x H x W in 0..1."""
    return torch.stack([torch.from_numpy(i).permute(2, 0, 1).float() / 255 for i in images])


def close(found: Tensor, wanted: np.ndarray, rtol: float = 0.0, atol: float = 1e-3) -> None:
    torch.testing.assert_close(found, torch.from_numpy(wanted), rtol=rtol, atol=atol)
