"""8 bits are written only where a recording shows that they lose next to nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyfn_core.cli import export as dyfn_export
from dyfn_core.cli.chosen_data import data_spec
from dyfn_core.data.frames import NumberedSequence
from dyfn_core.data.pool import open_pool
from dyfn_core.evaluation import int8
from dyfn_core.evaluation.int8 import Int8Error, write_int8_step
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import load_model
from dyfn_core.models.export import int8 as layers
from dyfn_core.models.export.session import load_step

pytest.importorskip("onnxruntime")
BAG = Path(__file__).parents[3] / "bags" / "demo"


@pytest.fixture(scope="module")
def mini() -> GeometryModel:
    return load_model("dyfn-mini")


@pytest.fixture(scope="module")
def drive() -> NumberedSequence:
    """Every 12th frame of the bundled drive."""
    found = open_pool([data_spec(str(BAG))], "train").sequences[0]
    frames = [found.read(12 * index) for index in range(18)]
    return NumberedSequence("a drive", range(len(frames)), frames.__getitem__)


def test_layers_in_8_bits_keep_the_scale(
    mini: GeometryModel, drive: NumberedSequence, tmp_path: Path
) -> None:
    path = tmp_path / "mini.onnx"
    info, loss = write_int8_step(mini, path, drive)
    assert info.precision == "int8" and load_step(path)[0] == info
    assert loss.accepted and loss.layers > 0 and loss.frames == 6
    assert 0 < loss.median < 0.01  # exact zero would be float32
    assert loss.exact_delta1 > 0.5


def test_layers_that_lose_the_scale_are_refused(
    mini: GeometryModel,
    drive: NumberedSequence,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every layer in 8 bits, DyFN and what the latent's statistics come from as well."""
    monkeypatch.setattr(layers, "kept_exact", lambda graph, beginnings: [])
    monkeypatch.setattr(int8, "CHOICES", {"all": ("",)})
    with pytest.raises(Int8Error, match=r"a drive.*all \(\d+ layers\): delta1 .*on 6 frames"):
        write_int8_step(mini, tmp_path / "mini.onnx", drive)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_fewer_layers_are_taken_where_more_lose_too_much(
    mini: GeometryModel,
    drive: NumberedSequence,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kept = layers.kept_exact

    def all_or_what_is_right(graph, beginnings):  # type: ignore[no-untyped-def]
        return [] if len(beginnings) == 2 else kept(graph, beginnings)

    monkeypatch.setattr(layers, "kept_exact", all_or_what_is_right)
    _, loss = write_int8_step(mini, tmp_path / "mini.onnx", drive)
    assert loss.choice == "encoder"


def test_dyfn_and_what_is_near_the_latent_stay_exact(mini: GeometryModel, tmp_path: Path) -> None:
    import onnx

    from dyfn_core.models.export.step_file import write_step

    write_step(mini, tmp_path / "mini.onnx", (96, 128))
    graph = onnx.load(str(tmp_path / "mini.onnx")).graph
    names = [node.name for node in graph.node if node.op_type in layers.LAYERS]
    exact = set(layers.kept_exact(graph, ("encode/", "decode/")))
    assert {name for name in names if name.startswith("stabilize/")} <= exact
    assert 0 < len(set(names) - exact) < len(names)
    encoder = layers.kept_exact(graph, ("encode/",))
    assert {name for name in names if name.startswith("decode/")} <= set(encoder)


def test_too_few_frames_are_refused(mini: GeometryModel, tmp_path: Path) -> None:
    few = NumberedSequence("few", range(8), lambda index: None)  # type: ignore[arg-type,return-value]
    with pytest.raises(ValueError, match="few"):
        write_int8_step(mini, tmp_path / "mini.onnx", few)


@pytest.mark.slow
def test_the_command_says_what_8_bits_cost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(int8, "FRAMES", 18)
    out = tmp_path / "mini.onnx"
    words = ["dyfn-mini", "--out", str(out), "--int8", "--calibrate", str(BAG)]
    assert dyfn_export.main(words) == 0
    assert "8 bits: encoder" in capsys.readouterr().out
    assert dyfn_export.main([*words, "--size", "100x80"]) == 2
    assert "--size is for images of 100x80" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        dyfn_export.main(words[:4])
    assert "--int8 and --calibrate RECORDING go together" in capsys.readouterr().err
