"""Names of devices, and what is said about a wrong one."""

from __future__ import annotations

import pytest
import torch

from dyfn_core.models import load_model
from dyfn_core.models.device import resolve_device


def test_auto_is_a_gpu_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert resolve_device("auto") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert resolve_device("auto") == torch.device("cuda")


def test_a_known_device_is_itself() -> None:
    assert resolve_device(torch.device("cpu")) == resolve_device("cpu") == torch.device("cpu")


def test_a_cuda_device_must_be_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert resolve_device("cuda:0") == torch.device("cuda:0")
    with pytest.raises(ValueError, match="no device 'cuda:1' here: torch finds 1 CUDA devices"):
        resolve_device("cuda:1")


def test_load_model_refuses_an_unknown_device() -> None:
    with pytest.raises(ValueError, match="device 'gpu' is unknown, expected auto, cpu, cuda"):
        load_model("dyfn-mini", "gpu")
