"""Without TensorRT or a GPU no engine is begun."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

from dyfn_core.cli import export as dyfn_export

WORDS = ["dyfn-mini", "--format", "tensorrt", "--size", "120x90", "--out"]


def test_without_tensorrt_the_command_says_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tensorrt", None)  # type: ignore[arg-type]
    assert dyfn_export.main([*WORDS, str(tmp_path / "mini.engine")]) == 2
    assert "pip install tensorrt" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_without_a_gpu_the_command_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    installed = ModuleType("tensorrt")
    installed.__version__ = "10.0"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "tensorrt", installed)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert dyfn_export.main([*WORDS, str(tmp_path / "mini.engine")]) == 2
    assert "TensorRT 10.0 is made on the NVIDIA GPU" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_engine_is_written_where_it_can_be(tmp_path: Path) -> None:
    """On a machine that has both: an engine that TensorRT reads again, with its metadata."""
    trt = pytest.importorskip("tensorrt", reason="needs TensorRT")
    if not torch.cuda.is_available():
        pytest.skip("needs an NVIDIA GPU")
    out = tmp_path / "mini.engine"
    assert dyfn_export.main([*WORDS, str(out)]) == 0
    runtime = trt.Runtime(trt.Logger(trt.Logger.ERROR))
    engine = runtime.deserialize_cuda_engine(out.read_bytes())
    names = {engine.get_tensor_name(index) for index in range(engine.num_io_tensors)}
    assert {"image", "points", "mask"} <= names
    assert '"image_size": [90, 120]' in out.with_name("mini.engine.json").read_text()
