"""A camera's stream with its hooks, without a graph: scene cuts, metres, saving and loading."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dyfn_core.stream.scene_cut_hook import SceneCutHook
from dyfn_core.stream.session import StreamFrame, StreamSession, stream_maker
from dyfn_core.stream.state_hook import StateError, StateHook, path_for
from dyfn_ros.node.metric_scale import MetricHook
from dyfn_ros.node.parameters.table import Settings
from tests.support.tiny_model import load_tiny


class Ports:
    """Remembers what would be published."""

    topic = "/reference"

    def __init__(self) -> None:
        self.published: list[Any] = []
        self.publish = self.published.append
        self.listener: Any = None


class Robot:
    """One camera as the node has it."""

    def __init__(self, **settings: Any) -> None:
        self.settings = Settings(**settings)
        model = load_tiny()
        self.ports, self.warnings = Ports(), []
        self.hooks: list[Any] = []
        self.stream = StreamSession(stream_maker(model), hooks=self.hooks)
        self.cut = SceneCutHook(lambda: self.settings.scene_cut_threshold)
        self.metric = MetricHook(lambda: self.settings, self.ports, self.warnings.append)  # type: ignore[arg-type]
        self.state = StateHook(self.stream, self.metric, self.cut, model)
        self.hooks += [self.cut, self.metric, self.state]
        self.epoch = 0

    def push(self, image: np.ndarray, stamp: float) -> Any:
        return self.stream.push(StreamFrame(image, stamp=stamp, epoch=self.epoch))

    def load(self, path: Path) -> str:
        def begin() -> int:
            self.epoch += 1
            return self.epoch

        return self.state.load(str(path), begin, self.settings.stabilize, self.settings.num_tokens)


def picture(seed: int, height: int = 36, width: int = 48) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(40, 216, (height // 4, width // 4, 3))
    return coarse.repeat(4, 0).repeat(4, 1).astype(np.uint8)


def cloud(points: np.ndarray, stamp: float) -> Any:
    fields = [
        SimpleNamespace(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")
    ]
    seconds = int(stamp)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=(stamp - seconds) * 1e9))
    data = points.astype("<f4").tobytes()
    size = {"height": 1, "width": len(points), "point_step": 12, "row_step": 12 * len(points)}
    return SimpleNamespace(header=header, fields=fields, is_bigendian=False, data=data, **size)


def test_a_scene_cut_resets_the_stream_and_is_off_at_zero() -> None:
    robot, still = Robot(scene_cut_threshold=0.5), Robot(scene_cut_threshold=0.0)
    for seed, stamp in ((0, 0.0), (0, 0.1), (1, 0.2), (1, 0.3)):
        robot.push(picture(seed), stamp)
        still.push(picture(seed), stamp)
    assert robot.stream.resets == {"scene cut": 1}
    assert not still.stream.resets
    assert robot.stream.stream.memory.frames == 2


def test_reference_gives_metres_after_its_first_second_until_the_next_reset() -> None:
    robot = Robot(metric_source="reference", scene_cut_threshold=0.0)
    relative = Robot(scene_cut_threshold=0.0)
    for step in range(13):
        stamp = 5 + step / 10
        plain = relative.push(picture(0), stamp)
        rows, columns = np.nonzero(plain.valid)
        points = 3.0 * plain.points[rows[::40], columns[::40]]
        robot.ports.listener(cloud(points, stamp))
        found = robot.push(picture(0), stamp)
        if step < 10:
            assert not found.metric
            assert not found.valid.any()
    assert found.metric
    np.testing.assert_allclose(found.depth[found.valid], 3 * plain.depth[found.valid], rtol=0.05)
    assert robot.ports.published[-1].map.scale == pytest.approx(3, rel=0.05)
    assert robot.hooks[1].report()["scale: unit"] == "metres"
    robot.epoch += 1
    assert not robot.push(picture(0), 6.3).metric
    assert "no measurement yet" in robot.metric.problems()[0]


def test_unreadable_stale_and_early_measurements_are_counted() -> None:
    robot = Robot(metric_source="reference", scene_cut_threshold=0.0)
    broken = cloud(np.ones((3, 3)), 5.0)
    broken.fields = []
    for message in (broken, cloud(np.ones((3, 3)), 1.0), cloud(np.ones((3, 3)), 50.0)):
        robot.ports.listener(message)
    robot.push(picture(0), 5.0)
    report = robot.metric.report()
    assert report["scale: not used, stale"] == "1"
    assert report["scale: not used, future-dated"] == "1"
    assert report["scale: not used, not decodable"] == "1"
    assert "expected x, y and z" in robot.warnings[0]


def test_loaded_state_gives_the_bytes_of_a_stream_that_never_stopped(tmp_path: Path) -> None:
    path = tmp_path / "s"
    robot = Robot(metric_source="fixed", metric_scale=2.0)
    for seed in range(3):
        robot.push(picture(0 if seed < 2 else 5), seed / 10)
    assert "saved 1 frames" in robot.state.save(str(path))  # since the cut
    expected = [robot.push(picture(5), 0.3 + step / 10).depth for step in range(3)]

    other = Robot(metric_source="fixed", metric_scale=2.0)
    other.load(path)
    found = [other.push(picture(5), 1000 + step / 10).depth for step in range(3)]
    for one, two in zip(expected, found, strict=True):
        np.testing.assert_array_equal(one, two)
    assert not other.stream.resets


def test_a_frame_from_before_the_load_does_not_touch_the_loaded_state(tmp_path: Path) -> None:
    robot = Robot(scene_cut_threshold=0.0)
    robot.push(picture(0), 0.0)
    robot.state.save(str(tmp_path / "s"))
    expected = robot.push(picture(1), 0.1).depth
    late = StreamFrame(picture(2), stamp=0.2, epoch=robot.epoch)
    robot.load(tmp_path / "s")
    robot.stream.push(late)
    np.testing.assert_array_equal(robot.push(picture(1), 0.3).depth, expected)


def test_state_that_does_not_fit_the_camera_is_refused(tmp_path: Path) -> None:
    robot, path = Robot(), tmp_path / "s"
    with pytest.raises(StateError, match="nothing to save yet"):
        robot.state.save(str(path))
    robot.push(picture(0), 0.0)
    robot.state.save(str(path))
    with pytest.raises(StateError, match="older file is kept"):
        robot.state.save(str(tmp_path / "no" / "s"))
    with pytest.raises(StateError, match="state_file is empty"):
        robot.state.save("")
    large = Robot()
    large.push(picture(0, 40, 60), 0.0)
    with pytest.raises(StateError, match="for images of 48 x 36 pixels, the camera's have 60 x 40"):
        large.load(path)
    with pytest.raises(StateError, match="saved with stabilize = True"):
        Robot(stabilize=False).load(path)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(StateError, match="damaged"):
        robot.load(path)


def test_cameras_that_share_a_path_have_files_of_their_own() -> None:
    assert path_for("/a/s.safetensors", "front", True) == "/a/s.front.safetensors"
    assert path_for("/a/s.safetensors", "front", False) == "/a/s.safetensors"
    assert path_for("", "front", True) == ""
