"""Checkpoints: every known format in, ours out, nothing lost on the way."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import dyfn_core
from dyfn_core.models import CheckpointError, checkpoints, load_model, save_model
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.mini import MiniModel
from dyfn_core.models.moge import MoGeModel
from tests.support.bases import small_da3

Official = dict[str, Any]


@pytest.fixture
def official(small_moge: MoGeModel) -> Official:
    """small_moge as a released file: official names, fp16 weights, stabilizer of hidden 256."""
    torch.manual_seed(0)
    model = MoGeModel(small_moge.architecture)
    model.stabilizer = build_dyfn(32, DyFNConfig())
    config = {key: value for key, value in model.config.items() if key != "type"}
    return {
        "model_config": {**config, "stabilizer_type": "ConvGRU"},
        "model": {
            ("head." + key if key.startswith("stabilizer.") else key): value.half()
            for key, value in model.state_dict().items()
        },
    }


def written(path: Path, content: object) -> Path:
    torch.save(content, path)
    return path


def test_official_file_loads_into_float32(official: Official, tmp_path: Path) -> None:
    model = load_model(written(tmp_path / "DyFN.pt", official))
    assert not model.training
    assert model.stabilizer.config == DyFNConfig(kind="convgru", hidden=256)
    state = model.state_dict()
    assert len(state) == len(official["model"])
    for key, value in official["model"].items():
        own = state[key.removeprefix("head.") if "stabilizer" in key else key]
        assert own.dtype == torch.float32
        assert torch.equal(own, value.float())


def test_official_gru_and_plain_files_load(official: Official, tmp_path: Path) -> None:
    plain = {k: v for k, v in official["model"].items() if "stabilizer" not in k}
    config = {k: v for k, v in official["model_config"].items() if k != "stabilizer_type"}
    base = load_model(written(tmp_path / "base.pt", {"model_config": config, "model": plain}))
    assert base.stabilizer is None
    gru = build_dyfn(32, DyFNConfig(kind="gru"))
    weights = {**plain, **{f"head.stabilizer.{k}": v for k, v in gru.state_dict().items()}}
    content = {"model_config": {**config, "stabilizer_type": "GRU"}, "model": weights}
    model = load_model(written(tmp_path / "gru.pt", content))
    assert model.stabilizer.config.kind == "gru"
    assert torch.equal(model.stabilizer.gru_cell.weight_hh, gru.gru_cell.weight_hh)


def test_legacy_options_of_official_files(
    official: Official, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = official["model_config"]
    del config["num_tokens_range"]
    config.update(trained_area_range=[196_000, 490_000], output_mask=True, split_head=True, odd=3)
    model = load_model(written(tmp_path / "old.pt", official))
    assert model.architecture.num_tokens_range == (1000, 2500)
    assert "odd = 3" in caplog.text
    config["split_head"] = False
    with pytest.raises(CheckpointError, match="split_head = False"):
        load_model(written(tmp_path / "older.pt", official))


def test_every_key_that_does_not_fit_is_listed(official: Official, tmp_path: Path) -> None:
    weights = official["model"]
    del weights["head.stabilizer.beta_head.bias"], weights["backbone.norm.weight"]
    weights["head.extra"] = torch.zeros(2, 3)
    weights["head.projects.0.weight"] = torch.zeros(7, 384, 1, 1)
    path = written(tmp_path / "broken.pt", official)
    with pytest.raises(CheckpointError) as caught:
        load_model(path)
    message = str(caught.value)
    assert str(path) in message
    for line in (
        "missing: head.stabilizer.beta_head.bias (32)",
        "missing: backbone.norm.weight (384)",
        "unexpected: head.extra (2x3)",
        "wrong shape: head.projects.0.weight is 7x384x1x1, expected 32x384x1x1",
    ):
        assert line in message
    assert message.count("\n") == 4


@pytest.mark.parametrize("kind", ["convgru", "gru", None])
def test_our_format_round_trip(small_moge: MoGeModel, tmp_path: Path, kind: str | None) -> None:
    torch.manual_seed(0)
    model = MoGeModel(replace(small_moge.architecture, mask_threshold=0.4)).eval()
    if kind:
        settings = DyFNConfig(kind=kind, hidden=6, pool=2, form="residual")
        model.stabilizer = build_dyfn(32, settings)
    path = tmp_path / "model.safetensors"
    save_model(model, path, notes={"steps": "12"})
    loaded = load_model(path)
    assert loaded.architecture == model.architecture
    assert loaded.mask_threshold == 0.4
    assert (loaded.stabilizer is None) == (kind is None)
    if kind:
        assert loaded.stabilizer.config == model.stabilizer.config
    state = loaded.state_dict()
    assert all(torch.equal(value, state[key]) for key, value in model.state_dict().items())
    image = np.random.default_rng(0).integers(0, 256, (40, 56, 3), dtype=np.uint8)
    assert torch.equal(loaded.infer(image).depth, model.infer(image).depth)
    assert checkpoints.read_checkpoint(path).notes == {"steps": "12"}
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.safetensors"]


def test_half_precision_file_is_half_the_size_and_loads_as_float32(
    small_moge: MoGeModel, tmp_path: Path
) -> None:
    save_model(small_moge, tmp_path / "full.safetensors")
    save_model(small_moge, tmp_path / "half.safetensors", dtype=torch.float16)
    full, half = ((tmp_path / f"{n}.safetensors").stat().st_size for n in ("full", "half"))
    assert half < 0.52 * full
    loaded = load_model(tmp_path / "half.safetensors")
    assert {value.dtype for value in loaded.state_dict().values()} == {torch.float32}


def test_mini_model_round_trip(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = MiniModel().eval()
    model.stabilizer = build_dyfn(
        model.latent_channels, DyFNConfig(hidden=8, pool=4, form="residual")
    )
    save_model(model, tmp_path / "mini.safetensors")
    loaded = load_model(tmp_path / "mini.safetensors")
    assert isinstance(loaded, MiniModel)
    assert loaded.config == model.config
    image = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    assert torch.equal(loaded.infer(image).depth, model.infer(image).depth)


def test_failed_save_leaves_the_old_file(
    small_moge: MoGeModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "model.safetensors"
    path.write_bytes(b"old")

    def full_disk(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(checkpoints, "save_file", full_disk)
    with pytest.raises(OSError, match="no space"):
        save_model(small_moge, path)
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


def _text(path: Path) -> None:
    path.write_text("not a checkpoint, just some text\n" * 10)


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _truncated_pickle(path: Path) -> None:
    torch.save({"model_config": {}, "model": {"a": torch.zeros(1000)}}, path)
    path.write_bytes(path.read_bytes()[:2000])


def _bare_weights(path: Path) -> None:
    torch.save({"a.weight": torch.zeros(3)}, path)


def _list(path: Path) -> None:
    torch.save([1, 2], path)


def _no_tensors(path: Path) -> None:
    torch.save({"model_config": {}, "model": {"a": 3}}, path)


def _foreign_safetensors(path: Path) -> None:
    save_file({"a": torch.zeros(3)}, path)


def _truncated_safetensors(path: Path) -> None:
    save_file({"a": torch.zeros(300)}, path, {"config": "{}"})
    path.write_bytes(path.read_bytes()[:200])


def _bad_json(path: Path) -> None:
    save_file({"a": torch.zeros(3)}, path, {"config": "{type"})


def _unknown_type(path: Path) -> None:
    save_file({"a": torch.zeros(3)}, path, {"config": '{"type": "midas"}'})


def _unknown_option(path: Path) -> None:
    save_file({"a": torch.zeros(3)}, path, {"config": '{"type": "moge", "colour": 1}'})


def _unknown_encoder(path: Path) -> None:
    torch.save({"model_config": {"encoder": "resnet"}, "model": {}}, path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (_text, "no checkpoint of a known format"),
        (_empty, "is empty"),
        (_truncated_pickle, "no checkpoint of a known format"),
        (_bare_weights, "expected 'model_config' and 'model', found .'a.weight'"),
        (_list, "found list"),
        (_no_tensors, "no tensors: .'a'"),
        (_foreign_safetensors, "no model config"),
        (_truncated_safetensors, "damaged safetensors"),
        (_bad_json, "no JSON"),
        (_unknown_type, "'midas' is unknown.*mini.*moge"),
        (_unknown_option, "unknown keys.*colour"),
        (_unknown_encoder, "encoder 'resnet' is unknown"),
    ],
)
def test_a_file_that_is_no_checkpoint_is_named(
    make: Callable[[Path], None], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "file.bin"
    make(path)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_model(path)
    assert str(path) in str(caught.value)


class Trap:
    """Would run code when unpickled without weights_only."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (Path(self.path),)


def test_pickled_code_does_not_run(tmp_path: Path) -> None:
    trace = tmp_path / "ran"
    path = written(tmp_path / "evil.pt", {"model_config": Trap(str(trace)), "model": {}})
    with pytest.raises(CheckpointError):
        load_model(path)
    assert not trace.exists()


@pytest.mark.parametrize("name", ["absent.pt", "runs/last.safetensors", "nothing"])
def test_missing_file_is_named(name: str) -> None:
    with pytest.raises(FileNotFoundError, match=name):
        load_model(name)


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("shawlyu/DyFN", "DyFN.pt"),
        ("Ruicheng/moge-vitl", "model.pt"),
        ("someone/model/sub/weights.pt", "sub/weights.pt"),
    ],
)
def test_without_a_network_the_error_says_what_to_put_where(
    name: str, file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def offline(**_: object) -> str:
        raise ConnectionError("name resolution failed")

    monkeypatch.setenv("DYFN_MODELS", str(tmp_path))
    monkeypatch.setattr("huggingface_hub.hf_hub_download", offline)
    with pytest.raises(FileNotFoundError) as caught:
        load_model(name)
    repo = "/".join(name.split("/")[:2])
    message = str(caught.value)
    assert f"no such file here, and cannot download {file} of Hub model {repo}" in message
    assert f"{repo}/resolve/main/{file}" in message
    assert str(tmp_path / repo / file) in message


def test_a_file_put_where_the_error_says_is_found(
    official: Official, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DYFN_MODELS", str(tmp_path))
    (tmp_path / "shawlyu" / "DyFN").mkdir(parents=True)
    written(tmp_path / "shawlyu" / "DyFN" / "DyFN.pt", official)
    assert load_model("shawlyu/DyFN").stabilizer is not None


def test_hub_download_is_used_when_there_is_a_network(
    official: Official, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, asked = written(tmp_path / "blob", official), []

    def download(repo_id: str, filename: str, **_: object) -> str:
        asked.append((repo_id, filename))
        return str(path)

    monkeypatch.setenv("DYFN_MODELS", str(tmp_path))
    monkeypatch.setattr("huggingface_hub.try_to_load_from_cache", lambda *_, **__: None)
    monkeypatch.setattr("huggingface_hub.get_hf_file_metadata", lambda *_, **__: None)
    monkeypatch.setattr("huggingface_hub.hf_hub_download", download)
    assert isinstance(load_model("shawlyu/DyFN"), MoGeModel)
    assert asked == [("shawlyu/DyFN", "DyFN.pt")]


def test_load_model_is_the_packages_front_door() -> None:
    assert dyfn_core.load_model is load_model
    for name in set(dyfn_core.__all__) - {"__version__"}:
        assert getattr(dyfn_core, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'absent'"):
        _ = dyfn_core.absent


def test_a_missing_file_in_a_folder_that_is_here_is_not_looked_for_on_the_hub(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "base").mkdir(parents=True)
    monkeypatch.setattr("huggingface_hub.hf_hub_download", lambda **_: pytest.fail("asked"))
    with pytest.raises(FileNotFoundError, match="no file of that path"):
        load_model("runs/base/model.safetensors")


def test_loading_draws_no_random_weights(tmp_path: Path) -> None:
    saved = small_da3("mono")  # has a buffer outside its state dict, so it is made on the CPU
    save_model(saved, tmp_path / "model.safetensors")
    before = torch.get_rng_state()
    loaded = load_model(tmp_path / "model.safetensors").state_dict()
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(loaded[key], value) for key, value in saved.state_dict().items())


def test_a_first_frame_needs_no_compiler() -> None:
    """Draws on the meta device import it, which takes longer than loading and the frame."""
    code = (
        "import sys, numpy, dyfn_core\n"
        "stream = dyfn_core.DepthStream(dyfn_core.load_model('dyfn-mini'), num_tokens=24)\n"
        "stream.push(numpy.full((48, 64, 3), 128, numpy.uint8))\n"
        "print([name for name in ('torch._dynamo', 'sympy') if name in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "[]\n"
