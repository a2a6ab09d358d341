"""A model's step as an ONNX file: it says what it is, and gives what torch gives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import onnx
import pytest
import torch

from dyfn_core import __version__
from dyfn_core.cli import export as dyfn_export
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import CheckpointError, load_model, model_fingerprint
from dyfn_core.models.export.parts import NEXT, state_from, state_tensors
from dyfn_core.models.export.session import load_step
from dyfn_core.models.export.step_file import KEY, info_of, write_step
from dyfn_core.prediction import StreamState
from tests.support.steps import CLOSE, SIZE, TOKENS, largest_difference


@pytest.fixture(scope="module")
def mini() -> GeometryModel:
    return load_model("dyfn-mini")


@pytest.fixture(scope="module")
def step(mini: GeometryModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("step") / "mini.onnx"
    write_step(mini, path, SIZE, TOKENS)
    return path


def test_the_step_with_dyfn_is_torchs_over_a_stream(mini: GeometryModel, step: Path) -> None:
    assert largest_difference(mini, step, stabilize=True) < CLOSE
    # The comparison can fail: DyFN is in the file.
    assert largest_difference(mini, step, stabilize=False, frames=5) > CLOSE


def test_the_base_has_a_step_without_state(mini: GeometryModel, tmp_path: Path) -> None:
    info = write_step(mini, tmp_path / "base.onnx", SIZE, TOKENS, stabilize=False)
    assert info.state == {} and not info.stabilized
    assert largest_difference(mini, tmp_path / "base.onnx", stabilize=False) < CLOSE


def test_a_file_says_what_it_is(mini: GeometryModel, step: Path) -> None:
    info, session = load_step(step)
    assert (info.version, info.weights) == (__version__, model_fingerprint(mini))
    assert (info.image_size, info.prepared_size, info.num_tokens) == (SIZE, (64, 96), TOKENS)
    assert info.preparation == mini.preparation and info.quantity == "depth"
    assert session.inputs == ("image", *info.state)
    assert session.outputs == ("points", "mask", *(NEXT + name for name in info.state))
    graph = onnx.load(str(step))
    onnx.checker.check_model(graph)
    assert [value.type.tensor_type.elem_type for value in graph.graph.output] == [1, 1, 1]


def test_other_files_are_refused(step: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.onnx"):
        load_step(tmp_path / "none.onnx")
    graph = onnx.load(str(step))
    del graph.metadata_props[:]
    onnx.save(graph, str(tmp_path / "foreign.onnx"))
    with pytest.raises(CheckpointError, match=r"foreign\.onnx is no step of a model"):
        load_step(tmp_path / "foreign.onnx")
    (tmp_path / "cut.onnx").write_bytes(step.read_bytes()[:100_000])
    with pytest.raises(CheckpointError, match=r"cut\.onnx cannot be loaded"):
        load_step(tmp_path / "cut.onnx")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{", "damaged"),
        ("[]", "damaged"),
        ('{"format": 0}', "format 0, expected 1"),
        ('{"format": 1}', "damaged"),
    ],
)
def test_damaged_metadata_are_named(text: str, told: str) -> None:
    with pytest.raises(CheckpointError, match=f"x.onnx.*{told}"):
        info_of({KEY: text}, "x.onnx")


def test_the_command_writes_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "mini.onnx"
    words = ["dyfn-mini", "--out", str(out), "--size", "120x90", "--num-tokens", "24"]
    assert dyfn_export.main(words) == 0
    said = capsys.readouterr().out
    assert "dyfn-mini with DyFN for images of 120 x 90 pixels" in said
    assert load_step(out)[0].image_size == SIZE
    assert dyfn_export.main([*words[:2], str(tmp_path / "no/such/folder.onnx")]) == 2
    assert "no/such" in capsys.readouterr().err


def test_a_state_of_another_kind_keeps_its_names() -> None:
    state = StreamState(torch.zeros(1, 3), torch.ones(1, 2), torch.ones(1, 2))
    assert list(state_tensors(state)) == ["hidden", "ema_mean", "ema_std"]
    assert state_from(state_tensors(replace(state, ema_std=None))).ema_std is None
