"""metric_source "model": what a metric model says becomes one scale for the stream."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from dyfn_core.metric.references import PointReference
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.moge2 import MoGe2Model
from dyfn_core.prediction import Frame, Prediction, StreamState
from dyfn_core.stream import depth_stream
from dyfn_core.stream.depth_stream import DepthStream, push_together
from dyfn_core.stream.model_stage import ModelStage
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.session import StreamSession
from tests.support.bases import small_da3, small_moge2
from tests.support.pinhole import PinholeModel

CAMERA = np.array([[70.0, 0, 39.5], [0, 70.0, 29.5], [0, 0, 1]])
OPTIONS = StreamOptions(metric_source="model", scene_cut_threshold=0.0, blank_contrast=0.0)


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (60, 80, 3)).astype(np.uint8)


def stabilized(model: GeometryModel) -> GeometryModel:
    """With a DyFN that clearly changes the scale."""
    torch.manual_seed(0)
    model.stabilizer = build_dyfn(model.latent_channels, DyFNConfig(hidden=4))
    torch.nn.init.constant_(model.stabilizer.gamma_head.bias, 4.0)  # type: ignore[arg-type,union-attr]
    torch.nn.init.constant_(model.stabilizer.beta_head.bias, 5.0)  # type: ignore[arg-type,union-attr]
    return model.eval()


def said(scale: float | None, stamp: float, dyfn: bool = True) -> tuple[Frame, Prediction]:
    """A frame of depth 2, and what the model says of its metres."""
    depth = np.full((4, 5), 2.0, np.float32)
    points = np.repeat(depth[..., None], 3, axis=-1)
    state = StreamState(torch.zeros(1, 1, 1, 1)) if dyfn else None
    mask = np.ones(depth.shape, bool)
    found = Prediction(points, depth, mask, np.eye(3), state, model_scale=scale)
    return Frame(np.zeros((4, 5, 3), np.uint8), stamp, CAMERA), found  # type: ignore[return-value]


def run(stage: ModelStage, scales: list[float | None], dyfn: bool = True) -> list[Prediction]:
    made = [said(scale, 0.1 * index, dyfn) for index, scale in enumerate(scales)]
    return [stage.after_prediction(frame, found) for frame, found in made]  # type: ignore[misc]


def test_one_bad_word_hardly_moves_the_streams_scale() -> None:
    rng = np.random.default_rng(0)
    words = [3.0 * math.exp(0.05 * rng.standard_normal()) for _ in range(40)]
    words[30] = 12.0
    found = run(ModelStage(lambda: OPTIONS), list(words))
    scales = np.array([float(one.depth[0, 0]) / 2.0 for one in found])
    assert all(one.metric for one in found)
    assert abs(scales[-1] / 3 - 1) < 0.05
    assert np.abs(np.diff(np.log(scales[10:]))).max() < 0.05
    # Scores see the stream's own unit, which metres that move must not move.
    assert all(one.aligned_quantity[0][0, 0] == pytest.approx(2.0) for one in found)


def test_frames_without_a_word_keep_the_scale() -> None:
    stage = ModelStage(lambda: OPTIONS)
    found = run(stage, [3.0, None, None])
    assert [float(one.depth[0, 0]) for one in found] == pytest.approx([6.0] * 3, rel=1e-6)
    assert stage.scale.age == pytest.approx(0.2)
    assert stage.metres_per_unit == pytest.approx(3.0)


def test_without_dyfn_every_frame_has_its_own_scale() -> None:
    found = run(ModelStage(lambda: OPTIONS), [3.0, 4.0], dyfn=False)
    assert [float(one.depth[0, 0]) for one in found] == pytest.approx([6.0, 8.0])


@pytest.mark.parametrize(("until", "valid"), [("withhold", False), ("relative", True)])
def test_before_the_first_word_depth_is_withheld_or_relative(until: str, valid: bool) -> None:
    options = StreamOptions(metric_source="model", until_metric=until)
    stage = ModelStage(lambda: options)
    (found,) = run(stage, [None])
    assert not found.metric
    assert bool(found.valid.all()) == valid
    assert stage.problems() == ["model: the model said nothing of metres"]
    assert stage.unused["the model said nothing of metres"] == 1


def test_after_a_reset_the_scale_is_kept_but_less_certain() -> None:
    stage = ModelStage(lambda: OPTIONS)
    run(stage, [3.0] * 20)
    before = stage.scale.spread
    stage.started("scene cut")
    (found,) = run(stage, [None])
    assert float(found.depth[0, 0]) == pytest.approx(6.0, rel=0.02)
    assert stage.scale.kept
    assert stage.scale.spread > 2 * before
    assert stage.problems() == ["model: kept from before a reset (scene cut)"]
    (found,) = run(stage, [6.0])
    assert not stage.scale.kept
    assert float(found.depth[0, 0]) > 8  # the new stream's word weighs more
    forgetful = ModelStage(lambda: StreamOptions(metric_source="model", after_reset="withhold"))
    run(forgetful, [3.0])
    forgetful.started("scene cut")
    (found,) = run(forgetful, [None])
    assert not found.metric


def test_a_reference_is_counted_and_not_used() -> None:
    session = StreamSession(small_moge2(), OPTIONS)
    session.add_reference(0.0, PointReference(np.ones((3, 3))))
    assert session.unused_references == {"a reference, but metric_source is model": 1}


def test_metres_of_a_stabilized_stream_are_those_of_the_images_own_latent() -> None:
    model = stabilized(small_moge2())
    session = StreamSession(model, OPTIONS)
    found = session.push(Frame(picture(), 0.0, CAMERA))
    fov = 2 * math.degrees(math.atan(40 / 70))
    own = model.infer(picture(), fov_x=fov, stabilize=False)
    both = own.mask.numpy() & found.mask
    assert found.metric
    ratio = np.median(own.depth.numpy()[both] / found.depth[both])
    assert ratio == pytest.approx(1.0, abs=0.02)
    unscaled = DepthStream(model, CAMERA).push(picture())
    affine = np.median(own.depth.numpy()[both] / unscaled.depth.numpy()[both])
    assert abs(affine / float(model.infer(picture()).depth.median()) - 1) > 0.02


def test_second_decodings_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_stream, "MEASURED_FIRST", 2)
    monkeypatch.setattr(depth_stream, "MEASURED_EVERY", 3)
    model = stabilized(small_moge2())
    calls = []
    decode = MoGe2Model.decode
    monkeypatch.setattr(
        MoGe2Model, "decode", lambda self, latent: calls.append(1) or decode(self, latent)
    )
    stream = DepthStream(model, CAMERA, num_tokens=6)
    stream.model_metres = True
    known = [stream.push(picture(seed)).model_scale is not None for seed in range(7)]
    assert known == [True, True, False, True, False, False, True]
    assert len(calls) == 7 + 4
    calls.clear()
    quiet = DepthStream(model, CAMERA, num_tokens=6)
    assert quiet.push(picture()).model_scale is None
    assert len(calls) == 1


def test_streams_of_a_batch_measure_for_themselves() -> None:
    model = stabilized(small_moge2())
    images = [picture(0), picture(1)]

    def streams() -> list[DepthStream]:
        made = [DepthStream(model, CAMERA, num_tokens=6) for _ in range(2)]
        made[0].model_metres = made[1].normals = True
        return made

    together = push_together(streams(), images)
    alone = [stream.push(image) for stream, image in zip(streams(), images, strict=True)]
    assert together[0].model_scale == pytest.approx(alone[0].model_scale)  # type: ignore[arg-type]
    assert together[1].model_scale is None
    assert together[0].normal is None
    torch.testing.assert_close(together[1].normal, alone[1].normal)


def test_depth_anything_3_metric_needs_the_camera() -> None:
    session = StreamSession(small_da3("metric"), OPTIONS)
    without = session.push(Frame(picture(), 0.0))
    assert not without.metric
    assert not without.valid.any()
    (problem,) = session.problems()
    assert problem == "model: the camera matrix is unknown, which this model needs for metres"
    found = session.push(Frame(picture(), 0.1, CAMERA))
    assert found.metric
    relative = DepthStream(small_da3("metric"), CAMERA).push(picture())
    focal = 70 * (56 / 80 + 42 / 60) / 2  # pixels of the network's image, 56 x 42
    np.testing.assert_allclose(
        found.depth[found.valid], relative.depth.numpy()[found.valid] * focal / 300, rtol=1e-5
    )


def test_state_goes_on_with_the_scale(tmp_path: Path) -> None:
    session = StreamSession(stabilized(small_moge2()), OPTIONS)
    for index in range(3):
        session.push(Frame(picture(index), 0.1 * index, CAMERA))
    session.save(str(tmp_path / "state.safetensors"))
    later = StreamSession(stabilized(small_moge2()), OPTIONS)
    later.load(str(tmp_path / "state.safetensors"))
    ours, theirs = (s.push(Frame(picture(9), 0.3, CAMERA)) for s in (session, later))
    np.testing.assert_array_equal(ours.depth, theirs.depth)


@pytest.mark.parametrize(
    ("model", "options", "expected"),
    [
        (PinholeModel, {"metric_source": "model"}, "the model knows no metres"),
        (lambda: small_da3("mono"), {"metric_source": "model"}, "the model knows no metres"),
        (lambda: small_da3("mono"), {"metric_source": "fixed"}, "calibration_fit 'scale_shift'"),
        (lambda: small_da3("mono"), {"metric_source": "odometry"}, "an unknown shift"),
    ],
)
def test_metres_that_the_output_cannot_have_are_refused(
    model: type, options: dict[str, str], expected: str
) -> None:
    with pytest.raises(ValueError, match=expected):
        StreamSession(model(), StreamOptions(**options))


def test_reference_finds_scale_and_shift_of_depth_anything_3_mono() -> None:
    options = StreamOptions(
        metric_source="reference",
        calibration_fit="scale_shift",
        calibration_points=20,
        calibration_seconds=0.05,
        blank_contrast=0.0,
    )
    model = small_da3("mono")
    last = model.model.head.scratch.output_conv2[2]
    assert isinstance(last, torch.nn.Conv2d)
    with torch.no_grad():
        last.weight.mul_(8.0)  # depths that span enough to tell a shift
    relative = model.infer(picture(), fov_x=2 * math.degrees(math.atan(40 / 70)))
    rows, columns = np.nonzero(relative.mask.numpy())
    chosen = np.random.default_rng(0).choice(len(rows), 60, replace=False)
    v, u = rows[chosen], columns[chosen]
    z = 3.0 * relative.depth.numpy()[v, u] + 1.5
    truth = np.stack([(u - 39.5) / 70 * z, (v - 29.5) / 70 * z, z], axis=-1)
    session = StreamSession(model, options)
    for stamp in (0.0, 0.1):
        session.add_reference(stamp, PointReference(truth))
        found = session.push(Frame(picture(), stamp, CAMERA))
    assert found.metric, session.problems()
    wanted = 3.0 * relative.depth.numpy() + 1.5
    np.testing.assert_allclose(found.depth[found.valid], wanted[found.valid], rtol=0.02)
