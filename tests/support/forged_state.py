"""State files of a stranger: whatever is in them, the digest that goes with it is right."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from dyfn_core.stream.state_file import FORMAT, _digest


def forge(path: Path, change: Callable[[dict[str, Any], dict[str, torch.Tensor]], None]) -> None:
    """The file with a changed description or tensors, and the digest that goes with it."""
    with safe_open(path, "pt") as opened:
        tensors = {key: opened.get_tensor(key) for key in opened.keys()}  # noqa: SIM118
        content = json.loads(opened.metadata()["content"])
    change(content, tensors)
    text = json.dumps(content)
    digest = _digest(text, tensors)
    save_file(tensors, path, {"format": FORMAT, "content": text, "digest": digest})


def hidden_of(content: dict[str, Any]) -> str:
    memory = content["state"]["fields"]["memory"]["fields"]
    name = memory["state"]["fields"]["hidden"]["tensor"]
    assert isinstance(name, str)
    return name


def forge_deep(path: Path) -> None:
    """A description as deep as no parser goes."""
    deep = "[" * 100_000 + "]" * 100_000
    tensors: dict[str, torch.Tensor] = {"0000": torch.zeros(1)}
    metadata = {"format": FORMAT, "content": deep, "digest": _digest(deep, tensors)}
    save_file(tensors, path, metadata)
