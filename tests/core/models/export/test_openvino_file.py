"""A model's step as OpenVINO's own files: they say what they are, and give what torch gives."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyfn_core.cli import export as dyfn_export
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import CheckpointError, load_model, model_fingerprint
from dyfn_core.models.export.parts import NEXT
from dyfn_core.models.export.session import load_step
from tests.support.pinhole import PinholeModel
from tests.support.steps import CLOSE, SIZE, TOKENS, largest_difference

pytest.importorskip("openvino")
from dyfn_core.models.export.openvino_file import write_openvino_step


@pytest.fixture(scope="module")
def mini() -> GeometryModel:
    return load_model("dyfn-mini")


@pytest.fixture(scope="module")
def step(mini: GeometryModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("step") / "mini.xml"
    write_openvino_step(mini, path, SIZE, TOKENS)
    return path


@pytest.mark.slow
def test_the_step_is_torchs_over_a_stream(mini: GeometryModel, step: Path) -> None:
    assert largest_difference(mini, step, stabilize=True) < CLOSE
    # The comparison can fail: DyFN is in the file.
    assert largest_difference(mini, step, stabilize=False, frames=5) > CLOSE


def test_the_files_say_what_they_are(mini: GeometryModel, step: Path) -> None:
    info, session = load_step(step)
    assert (info.weights, info.image_size) == (model_fingerprint(mini), SIZE)
    assert (info.num_tokens, info.precision) == (TOKENS, "float32")
    assert session.inputs == ("image", *info.state)
    assert session.outputs == ("points", "mask", *(NEXT + name for name in info.state))
    assert sorted(path.name for path in step.parent.iterdir()) == ["mini.bin", "mini.xml"]
    parameters = sum(value.numel() for value in mini.parameters())
    assert step.with_suffix(".bin").stat().st_size > 4 * parameters * 0.99  # not in half precision


def test_damaged_and_foreign_files_are_refused(tmp_path: Path) -> None:
    import openvino

    path = tmp_path / "pinhole.xml"
    write_openvino_step(PinholeModel().eval(), path, SIZE)
    weights = path.with_suffix(".bin").read_bytes()
    path.with_suffix(".bin").write_bytes(weights[: len(weights) // 2])
    with pytest.raises(CheckpointError, match=r"pinhole\.xml cannot be loaded by OpenVINO"):
        load_step(path)
    path.with_suffix(".bin").unlink()
    with pytest.raises(CheckpointError, match=r"pinhole\.xml cannot be loaded by OpenVINO"):
        load_step(path)
    port = openvino.opset13.parameter([4], name="image")
    port.output(0).get_tensor().set_names({"image"})
    result = openvino.opset13.relu(port)
    result.output(0).get_tensor().set_names({"depth"})
    foreign = tmp_path / "foreign.xml"
    openvino.save_model(openvino.Model([result], [port]), foreign)
    with pytest.raises(CheckpointError, match=r"foreign\.xml is no step of a model"):
        load_step(foreign)


@pytest.mark.slow
def test_the_command_writes_and_replaces(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "mini.xml"
    out.write_text("an older file")
    words = ["dyfn-mini", "--out", str(out), "--format", "openvino", "--size", "120x90"]
    assert dyfn_export.main(words) == 0
    assert "for images of 120 x 90 pixels" in capsys.readouterr().out
    assert load_step(out)[0].image_size == SIZE
    words[2] = str(tmp_path / "mini.onnx")
    assert dyfn_export.main(words) == 2
    assert "mini.onnx: a file for OpenVINO has a name that ends with .xml" in (
        capsys.readouterr().err
    )
    words[2] = str(tmp_path / "no/such/mini.xml")
    assert dyfn_export.main(words) == 2
    assert "no/such/mini.xml: cannot be written" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mini.bin", "mini.xml"]
    with pytest.raises(SystemExit):
        dyfn_export.main([*words, "--int8", "--calibrate", str(tmp_path)])
    assert "--int8 is for --format onnx, not openvino" in capsys.readouterr().err
