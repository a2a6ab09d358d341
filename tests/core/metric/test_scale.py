"""One interface over the sources of a metric scale, and measurements that wait for their frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from dyfn_core.metric.calibration import CalibrationOptions
from dyfn_core.metric.fit import MetricMap
from dyfn_core.metric.ground import up_from_pitch
from dyfn_core.metric.pairing import Pairing
from dyfn_core.metric.references import PointReference
from dyfn_core.metric.scale import MetricScale, ScaleOptions, to_metres

CAMERA = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])


@dataclass
class View:
    points: np.ndarray
    depth: np.ndarray
    valid: np.ndarray
    camera_matrix: np.ndarray
    frame_id: str = ""


def floor_view(pitch: float = 0.5) -> View:
    """A floor one unit below the camera."""
    v, u = np.mgrid[:48, :64].astype(float)
    rays = np.stack([(u - 31.5) / 60, (v - 23.5) / 60, np.ones_like(u)], -1)
    down = rays @ -up_from_pitch(pitch)
    depth = np.where(down > 0.05, 1 / np.maximum(down, 0.05), 100.0)
    return View(rays * depth[..., None], depth.astype(np.float32), depth < 50, CAMERA)


def measured(view: View, scale: float, seed: int = 0, count: int = 15) -> PointReference:
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(30, 47, count), rng.integers(1, 63, count)
    return PointReference(scale * view.points[rows, columns])


def test_without_a_source_depth_is_relative_and_says_so() -> None:
    view = floor_view()
    scale = MetricScale().push(view, 0.0, [measured(view, 2.0).evidence(view, 0.0)])
    assert not scale.metric
    assert scale.problem == "no metric source is configured"


def test_a_fixed_scale_is_there_at_once_and_outlives_resets() -> None:
    metric = MetricScale(ScaleOptions("fixed", 0.7))
    metric.reset()
    scale = metric.push(floor_view(), 0.0)
    assert (scale.map, scale.spread, scale.age) == (MetricMap(0.7), 0.0, 0.0)


def test_reference_calibrates_ages_and_is_forgotten_at_a_reset() -> None:
    metric, view = MetricScale(ScaleOptions("reference")), floor_view()
    for step in range(12):
        scale = metric.push(view, step / 10, [measured(view, 2.5, step).evidence(view, step / 10)])
        assert scale.metric == (step >= 10)
    assert scale.map is not None
    assert scale.map.scale == pytest.approx(2.5, rel=1e-3)
    assert scale.age == 0
    assert metric.push(view, 5.0).age == pytest.approx(3.9)
    metric.reset()
    assert metric.in_force(5.0).problem == "no measurement yet"


def test_camera_height_gives_the_scale() -> None:
    calibration = CalibrationOptions(min_points=5)
    up = tuple(up_from_pitch(0.5))
    options = ScaleOptions("camera_height", camera_height=1.4, up=up, calibration=calibration)
    metric = MetricScale(options)
    for step in range(11):
        scale = metric.push(floor_view(), step / 10)
    assert scale.map is not None
    assert scale.map.scale == pytest.approx(1.4, rel=0.02)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"source": "lidar"}, "source 'lidar' is unknown"),
        ({"source": "fixed", "metric_scale": 0.0}, "metric_scale must be positive"),
        ({"source": "camera_height"}, "camera_height must be positive metres"),
        ({"source": "camera_height", "camera_height": 1.0, "up": (0, 0, 0)}, "up must be"),
    ],
)
def test_unusable_options_are_refused(options: dict[str, object], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        ScaleOptions(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize("metric_map", [MetricMap(2.0), MetricMap(2.0, 0.3)])
def test_metres_stay_on_their_rays(metric_map: MetricMap) -> None:
    view = floor_view()
    points, depth, before = to_metres(view.points, view.depth, metric_map)
    np.testing.assert_allclose(depth, metric_map.scale * view.depth + metric_map.shift, rtol=1e-6)
    np.testing.assert_allclose(points[..., 2], depth, rtol=1e-5)
    np.testing.assert_allclose(
        points[..., :2] / points[..., 2:], view.points[..., :2] / view.points[..., 2:], atol=1e-5
    )
    assert before.all()


def test_a_shift_that_puts_points_behind_the_camera_makes_them_invalid() -> None:
    view = floor_view()
    _, depth, before = to_metres(view.points, view.depth, MetricMap(1.0, -2.0))
    np.testing.assert_array_equal(before, depth > 0)
    assert not before.all()


def test_measurements_wait_for_the_frame_of_their_time() -> None:
    pairing: Pairing[str] = Pairing(tolerance=0.05, ahead=1.0)
    for stamp, name in ((0.8, "stale"), (0.97, "a"), (1.04, "b"), (1.3, "later"), (9.0, "future")):
        pairing.put(stamp, name)
    assert pairing.take(1.0) == [(1.0, "a"), (1.0, "b")]
    assert pairing.take(1.0) == []
    assert pairing.take(1.28) == [(1.28, "later")]
    assert pairing.dropped == {"stale": 1, "future-dated": 1}


def test_measurements_that_come_late_belong_to_the_nearest_earlier_frame() -> None:
    pairing: Pairing[str] = Pairing(tolerance=0.1)
    for stamp, name in ((0.98, "now"), (0.93, "d"), (0.72, "b"), (0.55, "gone"), (0.86, "c")):
        pairing.put(stamp, name)
    assert pairing.take(1.0, [0.7, 0.8, 0.9]) == [(0.7, "b"), (0.9, "d"), (0.9, "c"), (1.0, "now")]
    assert pairing.dropped == {"stale": 1}


def test_too_many_waiting_measurements_cost_the_oldest() -> None:
    pairing: Pairing[int] = Pairing(tolerance=10, capacity=3)
    for number in range(5):
        pairing.put(0.0, number)
    assert pairing.take(0.0) == [(0.0, 2), (0.0, 3), (0.0, 4)]
    assert pairing.dropped == {"overrun": 2}
    pairing.put(0.0, 7)
    pairing.clear()
    assert pairing.take(0.0) == []
