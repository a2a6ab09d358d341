"""`make gpu-check`, as far as a CPU goes: the comparison, its bounds, the page and the refusal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
PAGE = BENCHMARKS.parent / "docs" / "GPU.md"


@pytest.fixture
def gpu_check(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import gpu_check

    return gpu_check


def test_a_device_is_compared_with_the_cpu(gpu_check: Any, tmp_path: Path) -> None:
    page = tmp_path / "GPU.md"
    page.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    words = ["--device", "cpu", "--models", "dyfn-mini", "--frames", "3", "--no-training"]
    assert gpu_check.main([*words, "--page", str(page)]) == 0
    now = page.read_text(encoding="utf-8")
    assert "| dyfn-mini | 0.0e+00 |" in now and now.startswith("# On a GPU")
    assert "| dyfn-mini | 0.0e+00 | 0.0e+00" not in now  # bfloat16 is another precision


def test_what_is_out_of_its_bounds_is_told(gpu_check: Any) -> None:
    right = gpu_check.Checked("a", 1e-5, 0.01, 1, 1)
    assert not list(right.wrong())
    for worst, bf16, told in [(0.01, 0.01, "float32"), (1e-5, 0.2, "bfloat16")]:
        (found,) = gpu_check.Checked("a", worst, bf16, 1, 1).wrong()
        assert told in found
    assert len(list(gpu_check.Checked("a", float("nan"), float("nan"), 1, 1).wrong())) == 2


@pytest.mark.slow
def test_training_steps_are_timed(gpu_check: Any) -> None:
    assert "s a step" in gpu_check.training(torch.device("cpu"))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_nothing_is_written(
    gpu_check: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert gpu_check.main(["--page", str(tmp_path / "GPU.md")]) == 2
    assert "torch finds no GPU here" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
