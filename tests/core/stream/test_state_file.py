"""State files: a stream goes on bit for bit, and whatever does not fit is refused with a reason."""

from __future__ import annotations

import errno
import json
import os
import resource
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file

from dyfn_core.files import OutputError
from dyfn_core.metric.calibration import ScaleCalibration
from dyfn_core.metric.fit import MetricMap
from dyfn_core.metric.references import Evidence
from dyfn_core.models.checkpoints import model_fingerprint
from dyfn_core.models.moge import MoGeModel
from dyfn_core.prediction import Frame
from dyfn_core.stream.depth_stream import DepthStream
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.plain_values import PlainError, from_plain, to_plain
from dyfn_core.stream.scene_cut import SceneCutDetector
from dyfn_core.stream.session import StreamSession
from dyfn_core.stream.state_file import (
    SavedStream,
    StateFileError,
    load_stream,
    restore,
    save_stream,
)
from tests.support.pinhole import PinholeModel, picture


def noise(seed: int, height: int = 50, width: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def played(model: MoGeModel, count: int = 3) -> DepthStream:
    stream = DepthStream(model)
    for seed in range(count):
        stream.push(noise(seed), seed * 0.1)
    return stream


def calibration() -> ScaleCalibration:
    window = Evidence(0.1, np.array([1.0, 2.0]), np.array([2.0, 4.1]), Counter({"missing": 2}))
    return ScaleCalibration(MetricMap(2.03), 0.01, 2, 0.1, 0.1, 0.0, (window,))


def test_loaded_state_goes_on_bit_for_bit_with_another_copy_of_the_model(
    small_moge: MoGeModel, tmp_path: Path
) -> None:
    stream = played(small_moge)
    path = tmp_path / "state.safetensors"
    save_stream(path, stream, model_fingerprint(small_moge))
    other = DepthStream(small_moge)
    restore(other, load_stream(path, model_fingerprint(small_moge)))
    for seed in range(3, 6):
        one, two = stream.push(noise(seed), seed * 0.1), other.push(noise(seed), seed * 0.1)
        assert torch.equal(one.depth, two.depth)
        assert torch.equal(one.points, two.points)
        assert torch.equal(one.intrinsics, two.intrinsics)
    assert stream.memory.focal == other.memory.focal
    assert stream.memory.shift == other.memory.shift
    assert stream.memory.frames == other.memory.frames == 6


def test_a_file_of_the_version_without_sessions_is_read() -> None:
    """Written by commit 0e04d73: three frames, a calibration, the cut detector's last image."""
    model = PinholeModel()
    session = StreamSession(model, StreamOptions(metric_source="reference"))
    loaded = session.load(str(Path(__file__).parent / "state_1.safetensors"))
    assert loaded.startswith("goes on after 3 frames")
    found = session.push(Frame(picture(3, 0.2), 99.0, frame_id="front"))
    assert found.reset is None and found.metric
    stream = DepthStream(model)
    expected = [stream.push(picture(seed, 0.2)) for seed in range(4)][-1]
    np.testing.assert_allclose(found.depth, 2.03 * expected.depth.numpy(), rtol=1e-6)
    assert session.stream is not None
    assert session.stream.memory.frames == 4


def test_everything_else_comes_back_as_it_was(small_moge: MoGeModel, tmp_path: Path) -> None:
    camera = np.array([[50.5, 0, 29.1], [0, 51, 24], [0, 0, 1]])
    stream = DepthStream(small_moge, camera)
    stream.push(noise(0), 0.0)
    detector = SceneCutDetector()
    detector.push(noise(1, 72, 96))
    saved = calibration()
    save_stream(
        tmp_path / "s",
        stream,
        "model",
        calibration=saved,
        cut=detector.state,
        notes={"frame_id": "front"},
    )
    loaded = load_stream(tmp_path / "s", "model")
    np.testing.assert_array_equal(loaded.camera_matrix, camera)
    assert loaded.notes == {"frame_id": "front"}
    assert loaded.calibration is not None
    assert loaded.calibration.map == saved.map
    assert loaded.calibration.window[0].dropped == {"missing": 2}
    np.testing.assert_array_equal(loaded.calibration.window[0].measured, [2.0, 4.1])
    assert loaded.cut is not None
    assert loaded.cut.look is not None
    assert detector.state.look is not None
    np.testing.assert_array_equal(loaded.cut.look.opponent, detector.state.look.opponent)


def test_a_new_stream_and_one_without_dyfn_can_be_saved(
    small_moge: MoGeModel, tmp_path: Path
) -> None:
    for name, stream in (
        ("new", DepthStream(small_moge)),
        ("base", DepthStream(small_moge, stabilize=False)),
    ):
        if name == "base":
            stream.push(noise(0))
        save_stream(tmp_path / name, stream, "m")
        assert load_stream(tmp_path / name, "m").memory == stream.memory


def test_another_models_state_is_refused(small_moge: MoGeModel, tmp_path: Path) -> None:
    save_stream(tmp_path / "s", played(small_moge), model_fingerprint(small_moge))
    other = PinholeModel(stabilized=True)
    with pytest.raises(StateFileError, match="s is the state of another model"):
        load_stream(tmp_path / "s", model_fingerprint(other))


def test_fingerprint_tells_weights_and_configuration_apart() -> None:
    one, same, tuned = (PinholeModel(stabilized=True) for _ in range(3))
    with torch.no_grad():
        tuned.unit += 1e-6
    assert model_fingerprint(one) == model_fingerprint(same)
    assert len({model_fingerprint(m) for m in (one, tuned, PinholeModel())}) == 3


@pytest.mark.parametrize(
    "options", [{"stabilize": False}, {"num_tokens": 1000}, {"shift_mode": "held"}]
)
def test_a_stream_with_other_options_refuses_and_stays_as_it_was(
    small_moge: MoGeModel, tmp_path: Path, options: dict[str, object]
) -> None:
    save_stream(tmp_path / "s", played(small_moge), "m")
    other = DepthStream(small_moge, **options)  # type: ignore[arg-type]
    memory = other.memory
    with pytest.raises(StateFileError, match=f"saved with {next(iter(options))} = "):
        restore(other, load_stream(tmp_path / "s", "m"))
    assert other.memory is memory


def test_a_missing_file_says_so(tmp_path: Path) -> None:
    with pytest.raises(StateFileError, match=r"cannot read .*nothing: No such file"):
        load_stream(tmp_path / "nothing", "m")
    with pytest.raises(StateFileError, match="Is a directory"):
        load_stream(tmp_path, "m")


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_damaged_file_is_refused_wherever_the_damage_is(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "s"
    stream = DepthStream(PinholeModel(stabilized=True))
    stream.push(noise(0))
    save_stream(path, stream, "m", calibration=calibration())
    whole = path.read_bytes()
    if data.draw(st.booleans()):
        path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    else:
        place = data.draw(st.integers(0, len(whole) - 1))
        broken = bytearray(whole)
        broken[place] ^= 1 << data.draw(st.integers(0, 7))
        path.write_bytes(broken)
    with pytest.raises(StateFileError, match=str(path)):
        load_stream(path, "m")


def test_other_safetensors_files_and_text_are_no_state(tmp_path: Path) -> None:
    save_file({"a": torch.ones(2)}, str(tmp_path / "model"), {"format": "dyfn 1"})
    with pytest.raises(StateFileError, match="format 'dyfn 1', expected a stream state"):
        load_stream(tmp_path / "model", "m")
    (tmp_path / "text").write_text("no state at all, " * 10)
    with pytest.raises(StateFileError, match="damaged, or no state file"):
        load_stream(tmp_path / "text", "m")


def test_a_full_disk_is_reported_and_leaves_the_old_file(
    small_moge: MoGeModel, tmp_path: Path
) -> None:
    """A real failing write: the kernel refuses to let the file grow."""
    path = tmp_path / "s"
    save_stream(path, played(small_moge, 1), "m")
    old = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(old) // 2, limits[1]))
    try:
        with pytest.raises(OutputError, match=os.strerror(errno.EFBIG)):
            save_stream(path, played(small_moge, 2), "m")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


def test_a_missing_folder_is_named(small_moge: MoGeModel, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=f"{tmp_path}/no/s: cannot be written: No such file"):
        save_stream(tmp_path / "no" / "s", played(small_moge, 1), "m")


def test_a_name_that_is_too_long_is_said(small_moge: MoGeModel, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written: File name too long"):
        save_stream(tmp_path / ("n" * 300), played(small_moge, 1), "m")


@settings(max_examples=80, deadline=None)
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.text() | st.floats(allow_nan=False),
        lambda inner: (
            st.lists(inner)
            | st.tuples(inner, inner)
            | st.dictionaries(st.text(), inner)
            | st.builds(Counter, st.dictionaries(st.text(), st.integers()))
        ),
        max_leaves=12,
    )
)
def test_plain_values_come_back_with_their_types(value: object) -> None:
    tensors: dict[str, torch.Tensor] = {}
    plain = json.loads(json.dumps(to_plain(value, tensors, {})))
    back = from_plain(plain, tensors, {})
    assert back == value
    assert type(back) is type(value)


def test_a_field_that_a_file_lacks_has_its_default_and_others_are_refused() -> None:
    kinds = {"Map": MetricMap}
    plain = {"type": "Map", "fields": {"scale": 2.0}}
    assert from_plain(plain, {}, kinds) == MetricMap(2.0, 0.0)
    for fields in ({"shift": 1.0}, {"scale": 2.0, "tilt": 1.0}):
        with pytest.raises(PlainError, match="expected"):
            from_plain({"type": "Map", "fields": fields}, {}, kinds)


def test_unknown_types_are_refused_both_ways() -> None:
    with pytest.raises(TypeError, match="object"):
        to_plain(object(), {}, {})
    with pytest.raises(TypeError, match="SavedStream"):
        to_plain(SavedStream(None, None), {}, {})  # type: ignore[arg-type]
    for bad in ({"type": "Popen", "fields": {}}, {"a": 1, "b": 2}, {"tensor": "9"}, {"what": 1}):
        with pytest.raises(PlainError):
            from_plain(bad, {}, {})
