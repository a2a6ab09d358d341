"""A model in another library than torch: the same stream, state, files and refusals."""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import CheckpointError, load_model, model_fingerprint
from dyfn_core.models.controls import frozen_control, stabilized_by
from dyfn_core.models.depth_anything import DepthAnythingConfig, DepthAnythingModel
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.export.backends import BackendError, on_backend
from dyfn_core.models.moge import MoGeModel
from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.depth_stream import DepthStream, push_together
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.session import StreamSession
from tests.support.bases import small_da3, small_moge2
from tests.support.pinhole import PinholeModel
from tests.support.seeded import redraw

SIZE, TOKENS = (60, 80), 12
FRAMES = 50
CLOSE = 1e-4  # relative, of depth


def walk(count: int, seed: int = 0) -> list[np.ndarray]:
    """Pictures that drift over a texture and change their brightness, H x W x 3 uint8."""
    rng = np.random.default_rng(seed)
    world = rng.uniform(0, 255, (30, 30, 3)).repeat(5, axis=0).repeat(5, axis=1)
    height, width = SIZE
    return [
        (world[i : i + height, i : i + width] * (0.7 + 0.3 * np.cos(i / 5))).astype(np.uint8)
        for i in range(count)
    ]


def with_dyfn(model: GeometryModel, config: DyFNConfig) -> GeometryModel:
    torch.manual_seed(0)
    model.stabilizer = build_dyfn(model.latent_channels, config)
    heads = [p for name, p in model.stabilizer.named_parameters() if "head.weight" in name]
    redraw(heads, 0.3, seed=0)
    return model.eval()


def depth_anything() -> GeometryModel:
    torch.manual_seed(0)
    model = DepthAnythingModel(DepthAnythingConfig())
    torch.nn.init.ones_(model.depth_head.scratch.output_conv2[2].bias)  # disparity around 1
    return with_dyfn(model, DyFNConfig(hidden=8, pool=4))


MODELS: dict[str, Callable[[], GeometryModel]] = {
    "moge2": lambda: with_dyfn(small_moge2(), DyFNConfig("gru", hidden=8)),
    "depth anything 2": depth_anything,
    "depth anything 3": lambda: small_da3("metric"),
}


@pytest.fixture(scope="module")
def mini() -> GeometryModel:
    return load_model("dyfn-mini")


@pytest.fixture(scope="module")
def fast(mini: GeometryModel) -> GeometryModel:
    return on_backend(mini, "onnxruntime")


def run(model: GeometryModel, frames: list[np.ndarray], **options: bool) -> list[Prediction]:
    stream = DepthStream(model, num_tokens=TOKENS, **options)
    return [stream.push(frame) for frame in frames]


def largest_difference(one: list[Prediction], other: list[Prediction]) -> float:
    worst = 0.0
    for a, b in zip(one, other, strict=True):
        both = a.valid & b.valid
        assert both.float().mean() > 0.5
        assert (a.mask != b.mask).float().mean() < 1e-3
        worst = max(worst, float((b.depth[both] / a.depth[both] - 1).abs().max()))
    return worst


def same(one: list[Prediction], other: list[Prediction]) -> bool:
    return all(torch.equal(a.points, b.points) for a, b in zip(one, other, strict=True))


@torch.inference_mode()
def network_difference(one: GeometryModel, other: GeometryModel, stabilize: bool) -> float:
    """Of depth or disparity, relative, over a stream whose state each side carries by itself."""
    worst, first, second = 0.0, None, None
    for frame in walk(FRAMES):
        image = torch.from_numpy(frame).permute(2, 0, 1)[None] / 255
        expected, first = one.predict_affine(image, first, TOKENS, stabilize)
        found, second = other.predict_affine(image, second, TOKENS, stabilize)
        assert (first is None) == (second is None)
        worst = max(worst, float((found.values / expected.values - 1).abs().max()))
    return worst


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_mini_is_torchs_over_a_stream(mini: GeometryModel, backend: str) -> None:
    pytest.importorskip(backend)
    other = on_backend(mini, backend)
    assert other.backend == backend and mini.backend == "torch"
    assert largest_difference(run(mini, walk(FRAMES)), run(other, walk(FRAMES))) < CLOSE
    plain = run(mini, walk(5), stabilize=False)
    assert largest_difference(plain, run(other, walk(5), stabilize=False)) < CLOSE
    # The comparison can fail: the stream is another one without DyFN.
    assert largest_difference(plain, run(other, walk(5))) > CLOSE


SIGNALS = """
import gc, importlib, signal, sys
from onnx import TensorProto, helper

ports = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [4]) for name in ("image", "depth")]
double = helper.make_node("Add", ["image", "image"], ["depth"])
graph = helper.make_graph([double], "double", ports[:1], ports[1:])
model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)]).SerializeToString()
module = importlib.import_module("dyfn_core.models.export." + sys.argv[1])
graphs = [getattr(module, sys.argv[2])(model) for _ in range(5)]
while graphs:  # the first one made goes first
    graphs.pop(0)
    gc.collect()
caught = []
signal.signal(signal.SIGCHLD, lambda *_: caught.append(1))
signal.raise_signal(signal.SIGCHLD)
print("caught", len(caught))
"""


@pytest.mark.parametrize(
    ("backend", "module", "name"),
    [
        ("onnxruntime", "session", "OnnxSession"),
        ("openvino", "openvino_graph", "OpenVinoGraph"),
    ],
)
def test_signals_are_caught_after_graphs_are_gone(backend: str, module: str, name: str) -> None:
    pytest.importorskip(backend)
    code = [sys.executable, "-c", SIGNALS, module, name]
    root = Path(__file__).parents[4]
    done = subprocess.run(code, capture_output=True, text=True, cwd=root, timeout=120)
    assert (done.returncode, done.stdout) == (0, "caught 1\n"), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_todays_bases_are_torchs_over_a_stream(name: str) -> None:
    model = MODELS[name]()
    assert network_difference(model, on_backend(model, "onnxruntime"), True) < CLOSE


@pytest.mark.slow
def test_moge_is_decoded_at_the_sizes_of_the_release(small_moge: MoGeModel) -> None:
    other = on_backend(small_moge, "onnxruntime")
    for stabilize in (True, False):
        assert network_difference(small_moge, other, stabilize) < CLOSE


@pytest.mark.slow
def test_metres_and_normals_come_from_there_too() -> None:
    model = with_dyfn(small_moge2(), DyFNConfig(hidden=8))
    other, image = on_backend(model, "onnxruntime"), walk(1)[0]
    expected, found = model.infer(image), other.infer(image)
    assert found.metric and found.normal is not None and expected.normal is not None
    assert float((found.depth / expected.depth)[expected.valid].sub(1).abs().max()) < CLOSE
    assert float((found.normal - expected.normal).abs().max()) < CLOSE
    stream = DepthStream(other)
    stream.model_metres = True
    assert stream.push(image).model_scale is not None


def test_the_bits_do_not_depend_on_other_cameras(fast: GeometryModel) -> None:
    left, right = walk(4), walk(4, seed=1)
    alone = run(fast, left)
    assert same(run(fast, left), alone)
    streams = [DepthStream(fast, num_tokens=TOKENS) for _ in range(2)]
    together = [push_together(streams, pair) for pair in zip(left, right, strict=True)]
    assert same([pair[0] for pair in together], alone)
    assert same([pair[1] for pair in together], run(fast, right))


def test_a_state_goes_from_one_library_to_another(
    mini: GeometryModel, fast: GeometryModel, tmp_path: Path
) -> None:
    options = StreamOptions(num_tokens=TOKENS, scene_cut_threshold=0.0)
    frames = [Frame(image, i / 10) for i, image in enumerate(walk(8))]
    first, second = StreamSession(mini, options), StreamSession(fast, options)
    for frame in frames[:5]:
        first.push(frame)
    first.save(str(tmp_path / "state.safetensors"))
    second.load(str(tmp_path / "state.safetensors"))
    for frame in frames[5:]:
        expected, found = first.push(frame), second.push(frame)
        assert found.reset is None
        np.testing.assert_allclose(
            found.depth[expected.valid], expected.depth[expected.valid], rtol=CLOSE
        )
    assert second.fingerprint == first.fingerprint == model_fingerprint(fast)
    second.request_reset()
    again = second.push(replace(frames[5], stamp=0.8))
    alone = StreamSession(fast, options).push(frames[5])
    assert again.reset and np.array_equal(again.depth, alone.depth)


def test_a_control_takes_dyfns_place(mini: GeometryModel, fast: GeometryModel) -> None:
    control = frozen_control(mini.latent_channels)
    with stabilized_by(fast, control):
        found = run(fast, walk(3))
    with stabilized_by(mini, control):
        expected = run(mini, walk(3))
    assert largest_difference(expected, found) < CLOSE


def test_a_state_of_another_size_is_refused(fast: GeometryModel) -> None:
    with torch.inference_mode():
        _, state = fast.predict_affine(torch.rand(1, 3, *SIZE), None, TOKENS)
        with pytest.raises(ValueError, match="another image size, batch or model"):
            fast.predict_affine(torch.rand(1, 3, *SIZE), state, 100)
        with pytest.raises(ValueError, match=r"of 1 streams.*needs 2"):
            fast.predict_affine(torch.rand(2, 3, *SIZE), state, TOKENS)


def pinhole_parts(folder: Path) -> list[Path]:
    return sorted(folder.glob("pinhole-*.onnx"))


def test_what_was_exported_is_used_again(
    exports: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO, "dyfn_core")
    model, image = PinholeModel().eval(), walk(1)
    expected = run(on_backend(model, "onnxruntime"), image)
    names = [path.name.split("-")[1] for path in pinhole_parts(exports)]
    assert names == ["decode", "encode"]
    assert str(exports) in caplog.text and caplog.text.count(": exported") == 2
    monkeypatch.setattr(torch.onnx, "export", None)  # nothing is exported a second time
    assert same(run(on_backend(model, "onnxruntime"), image), expected)
    assert caplog.text.count(": used") == 2


def test_a_foreign_file_in_the_cache_is_refused(exports: Path) -> None:
    model = PinholeModel().eval()
    run(on_backend(model, "onnxruntime"), walk(1))
    encode = next(path for path in pinhole_parts(exports) if "-encode-" in path.name)
    graph = onnx.load(str(encode))
    entry = graph.metadata_props[0]
    entry.value = entry.value.replace(model_fingerprint(model), "0" * 64)
    onnx.save(graph, str(encode))
    with pytest.raises(CheckpointError, match=rf"{encode.name} .*weights is '0+', expected"):
        run(on_backend(model, "onnxruntime"), walk(1))
    encode.write_bytes(b"no graph")
    with pytest.raises(CheckpointError, match=rf"{encode.name} is no exported part"):
        run(on_backend(model, "onnxruntime"), walk(1))
    encode.unlink()


def test_without_a_cache_it_runs_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("DYFN_EXPORTS", str(tmp_path / "file"))
    run(on_backend(PinholeModel().eval(), "onnxruntime"), walk(1))
    assert "an exported encode is not kept" in caplog.text


def test_auto_says_what_it_takes(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO, "dyfn_core")
    model = PinholeModel().eval()
    assert on_backend(model, "auto").backend == "onnxruntime"
    assert "backend auto: onnxruntime" in caplog.text
    for name in ("onnxruntime", "openvino"):
        monkeypatch.setitem(sys.modules, name, None)  # type: ignore[arg-type]
        monkeypatch.delitem(sys.modules, "dyfn_core.models.export.session", raising=False)
    assert on_backend(model, "auto") is model
    assert "backend auto: torch" in caplog.text
    with pytest.raises(BackendError, match=r"pip install 'dyfn_ros\[onnx\]'"):
        on_backend(model, "onnxruntime")


@pytest.mark.parametrize(
    ("backend", "told"),
    [
        ("onnx", "backend 'onnx' is unknown, expected one of torch, auto, onnxruntime"),
        ("tensorrt", "needs an NVIDIA GPU as device"),
    ],
)
def test_what_cannot_run_here_is_refused(backend: str, told: str) -> None:
    with pytest.raises(BackendError, match=told):
        load_model("dyfn-mini", backend=backend)
