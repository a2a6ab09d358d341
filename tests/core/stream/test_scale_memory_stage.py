"""Option scale_memory: a session whose model's scale flickers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dyfn_core.models.base import AffineDisparity, Latent
from dyfn_core.prediction import DISPARITY, Frame, Prediction
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.saving import StateError
from dyfn_core.stream.session import StreamSession
from tests.core.stream.test_motion_stage import OWN_CAMERA, UNIT, WHOLE
from tests.support.pinhole import PinholeModel
from tests.support.textured_plane import SIZE, plane_view, walk

FLICKER = 0.2 * np.random.default_rng(1).standard_normal(8)


@pytest.fixture(scope="module")
def walked() -> list[tuple[Frame, np.ndarray]]:
    """Red says the depth to PinholeModel, green has the texture; the true depth."""
    found = []
    for i, (pose, error) in enumerate(zip(walk(8, step=0.12), FLICKER, strict=True)):
        view = plane_view(pose, WHOLE, OWN_CAMERA)
        image = np.zeros((*SIZE, 3), np.uint8)
        image[..., 0] = np.round((view.depth * np.exp(error) / UNIT / 2) * 255)
        image[..., 1] = view.image[..., 1]
        found.append((Frame(image, 0.5 * i, OWN_CAMERA), view.depth))
    return found


class HalvedModel(PinholeModel):
    """Depth is twice the red channel: there is room for a flicker."""

    def decode(self, latent: Latent) -> Any:
        features = latent.features.clone()
        features[:, 0] = 2 * features[:, 0] - 0.5
        return super().decode(Latent(features, latent.image_size, latent.network_size))


def session_of(**options: Any) -> StreamSession:
    return StreamSession(HalvedModel(), StreamOptions(scene_cut_threshold=0.0, **options))


def spread(found: list[Prediction[np.ndarray]], walked: list[tuple[Frame, np.ndarray]]) -> float:
    ratios = [np.median(one.depth / true) for one, (_, true) in zip(found, walked, strict=True)]
    return float(np.std(np.log(ratios)))


def test_depth_and_points_keep_one_scale(walked: list[tuple[Frame, np.ndarray]]) -> None:
    without, session = session_of(), session_of(scale_memory=True)
    plain = [without.push(frame) for frame, _ in walked]
    found = [session.push(frame) for frame, _ in walked]
    assert spread(found, walked) < 0.4 * spread(plain, walked)
    np.testing.assert_array_equal(found[0].depth, plain[0].depth)
    for one in found:
        np.testing.assert_allclose(one.points[..., 2], one.depth, rtol=1e-6)
    assert "earlier pictures" in session.report()["scale memory"]
    assert "scale memory" not in without.report()


def test_metres_are_of_the_steadied_depth(walked: list[tuple[Frame, np.ndarray]]) -> None:
    session = session_of(scale_memory=True)
    metric = session_of(scale_memory=True, metric_source="fixed", metric_scale=2.0)
    for frame, _ in walked[:3]:
        one, two = session.push(frame), metric.push(frame)
        np.testing.assert_array_equal(2 * one.depth, two.depth)
        assert two.metric


def test_a_reset_ends_the_memory(walked: list[tuple[Frame, np.ndarray]]) -> None:
    session = session_of(scale_memory=True)
    for frame, _ in walked[:3]:
        session.push(frame)
    session.request_reset()
    after = session.push(walked[3][0])
    np.testing.assert_array_equal(after.depth, session_of().push(walked[3][0]).depth)


def test_a_saved_state_goes_on_with_the_same_bits(
    walked: list[tuple[Frame, np.ndarray]], tmp_path: Path
) -> None:
    whole, other = (session_of(scale_memory=True) for _ in range(2))
    for frame, _ in walked[:4]:
        whole.push(frame)
    path = str(tmp_path / "state.safetensors")
    whole.save(path)
    other.load(path)
    for frame, _ in walked[4:]:
        np.testing.assert_array_equal(whole.push(frame).depth, other.push(frame).depth)
    with pytest.raises(StateError, match="saved with scale_memory"):
        session_of().load(path)


def test_what_cannot_have_it_says_so() -> None:
    with pytest.raises(ValueError, match=r"scale_memory is True.*odometry"):
        StreamOptions(scale_memory=True, metric_source="odometry")

    class DisparityModel(PinholeModel):
        quantity = DISPARITY

        def decode(self, latent: Latent) -> Any:
            return AffineDisparity(torch.ones(1, *latent.image_size))

    with pytest.raises(ValueError, match=r"scale_memory is True.*disparity"):
        StreamSession(DisparityModel(), StreamOptions(scale_memory=True))
    session = session_of()
    with pytest.raises(ValueError, match="for the whole session"):
        session.options = StreamOptions(scene_cut_threshold=0.0, scale_memory=True)
