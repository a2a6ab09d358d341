"""Two cameras in one node: own streams, own topics, one batch; resets and diagnostics of each."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
import torch
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import LoggerLevel
from rcl_interfaces.srv import ListParameters, SetLoggerLevels
from rclpy.qos import (
    DurabilityPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import Float32

from dyfn_core.geometry.edges import flying_pixels
from dyfn_core.stream.depth_stream import DepthStream
from dyfn_ros.messages.clouds import cloud_points
from dyfn_ros.messages.compressed_depth import decode_compressed_depth
from tests.support.probe import Probe, stamp_of, stamped, statuses
from tests.support.ros_graph import (
    NODE,
    NodeProcess,
    camera_info,
    frames,
    image_message,
    own_domain,
    tiny_node,
)
from tests.support.tiny_model import FAILING, load_tiny

BOTH = ("front", "left")
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Rig:
    """The node with two cameras, and the time of the images that were sent to it."""

    def __init__(self, node: NodeProcess, probe: Probe) -> None:
        self.node, self.probe = node, probe
        self.now = 100.0
        self._count = 0
        for camera in BOTH:
            probe.listen(f"{camera}/depth/image", Image)
            probe.listen(f"{camera}/resets", DiagnosticArray, LATCHED)
        probe.listen("/diagnostics", DiagnosticArray)

    def send(self, camera: str, rgb: np.ndarray, step: float = 0.1, **header: Any) -> int:
        """-> the stamp in nanoseconds, which no other image has, also when time goes back."""
        self.now += step
        self._count += 1
        stamp = round(self.now * 1e6) * 1000 + self._count % 1000
        self.probe.publish(f"/{camera}/image", stamped(image_message(rgb), stamp, **header))
        return stamp

    def depth(self, camera: str, stamp: int) -> bytes:
        """The depth image of a frame that was sent."""
        return bytes(self.message(f"{camera}/depth/image", stamp).data)

    def message(self, topic: str, stamp: int) -> Any:
        def found() -> Any:
            return next((m for m in self.probe.received[topic] if stamp_of(m) == stamp), None)

        return self.probe.wait(found)

    def play(self, camera: str, images: list[np.ndarray], **header: Any) -> list[bytes]:
        stamps = [self.send(camera, image, **header) for image in images]
        return [self.depth(camera, stamp) for stamp in stamps]

    def reset(self) -> None:
        assert self.probe.trigger("reset").success

    def reset_at(self, camera: str, stamp: int) -> tuple[str, dict[str, str]]:
        """Reason, and counts by reason, of the reset with this frame."""
        status = self.message(f"{camera}/resets", stamp).status[0]
        return status.message, {v.key: v.value for v in status.values}

    def diagnostics(self) -> dict[str, tuple[str, dict[str, str]]]:
        """The next that comes."""
        known = self.probe.received["/diagnostics"]
        count = len(known)
        self.probe.wait(lambda: len(known) > count)
        return statuses(known[-1])


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    parameters = {
        "cameras": "[front, left]",
        "drop_frames": False,
        "diagnostics_period": 0.1,
        "left.max_gap": 50.0,
        "left.reliability": "reliable",
        "left.device": "cpu",
    }
    with own_domain() as environment:
        node = tiny_node(environment, tmp_path_factory.mktemp("node"), **parameters)
        probe = Probe(environment)
        try:
            yield primed(Rig(node, probe))
            assert node.end() == 0, node.log
        finally:
            probe.close()
            node.kill()


def primed(rig: Rig) -> Rig:
    """Both cameras' frames come back, and none is under way."""
    rig.probe.wait(lambda: rig.probe.received["/diagnostics"])  # spins: the model is loaded
    for camera in BOTH:
        topic = f"{camera}/depth/image"
        while not rig.probe.received[topic]:
            rig.send(camera, frames(1)[0])
            rig.probe.spin_until(lambda t=topic: rig.probe.received[t], 1.0)
        rig.play(camera, frames(1))
    return rig


@pytest.fixture
def rig(both: Rig) -> Rig:
    """Both streams reset with the next frame."""
    both.reset()
    return both


def alone(images: list[np.ndarray], matrix: np.ndarray | None = None) -> list[np.ndarray]:
    """The depth that one stream gives in this process, NaN where it is not valid."""
    stream = DepthStream(load_tiny(), camera_matrix=matrix)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    predictions = [stream.push(image) for image in images]
    torch.set_num_threads(threads)
    return [torch.where(p.mask, p.depth, torch.nan).numpy() for p in predictions]


def assert_close(got: np.ndarray, expected: np.ndarray) -> None:
    """Equal but for the last bits, which a batch changes, also on which side of the mask's edge."""
    both = ~np.isnan(got) & ~np.isnan(expected)
    assert (np.isnan(got) != np.isnan(expected)).mean() < 0.005
    assert both.mean() > 0.3
    np.testing.assert_allclose(got[both], expected[both], rtol=1e-4)


def as_depth(data: bytes, height: int = 36, width: int = 48) -> np.ndarray:
    return np.frombuffer(data, "<f4").reshape(height, width)


def test_each_camera_has_a_stream_of_its_own(rig: Rig) -> None:
    """Interleaved or together, each gives what it would give alone."""
    images = {camera: frames(4, seed=i) for i, camera in enumerate(BOTH)}
    stamps = {camera: [] for camera in BOTH}
    for index in range(4):
        for camera in BOTH:
            stamps[camera].append(rig.send(camera, images[camera][index]))
    for camera in BOTH:
        for stamp, expected in zip(stamps[camera], alone(images[camera]), strict=True):
            got = as_depth(rig.depth(camera, stamp))
            assert_close(got, expected)


def test_without_batches_a_camera_gets_the_very_bytes_it_gets_alone(rig: Rig) -> None:
    assert rig.probe.set("batch", False).successful
    stamps = []
    images = frames(3, seed=5)
    for image in images:
        stamps.append(rig.send("front", image))
        rig.send("left", frames(1, seed=9)[0])
    expected = [depth.tobytes() for depth in alone(images)]
    assert [rig.depth("front", stamp) for stamp in stamps] == expected
    assert rig.probe.set("batch", True).successful


def test_a_camera_that_fails_or_is_bad_costs_the_other_nothing(rig: Rig) -> None:
    rig.play("left", frames(1))
    failing = frames(1)[0].copy()
    failing[0, 0] = FAILING
    good = frames(3, seed=4)
    stamps = []
    for image in good:
        rig.send("left", failing)
        stamps.append(rig.send("front", image))
    for stamp, expected in zip(stamps, alone(good), strict=True):
        assert_close(as_depth(rig.depth("front", stamp)), expected)
    stamp = rig.send("left", frames(1)[0])
    assert rig.reset_at("left", stamp)[0] == "inference failed"


def test_one_camera_can_be_reset_alone(rig: Rig) -> None:
    images = frames(2)
    first = {camera: rig.play(camera, images) for camera in BOTH}
    assert rig.probe.trigger("left/reset").success
    again = {camera: rig.play(camera, images) for camera in BOTH}
    assert again["left"] == first["left"]
    assert again["front"] != first["front"]


@pytest.mark.parametrize(
    ("step", "header", "reason"),
    [
        (-1.0, {}, "stamp went back"),
        (20.0, {}, "gap between stamps"),
        (0.1, {"frame_id": "other"}, "frame_id changed"),
    ],
)
def test_what_ends_the_past_is_published_with_its_reason_and_stamp(
    rig: Rig, step: float, header: dict[str, str], reason: str
) -> None:
    first = rig.play("front", frames(2))
    before = int(rig.diagnostics()["stream_depth: front"][1].get(f"resets: {reason}", 0))
    stamp = rig.send("front", frames(2)[0], step, **header)
    assert rig.depth("front", stamp) == first[0]
    found, counts = rig.reset_at("front", stamp)
    assert found == reason
    assert int(counts[reason]) == before + 1
    assert rig.diagnostics()["stream_depth: front"][1][f"resets: {reason}"] == counts[reason]
    rig.play("front", frames(1))  # back to the usual frame_id


def test_a_camera_may_have_a_value_of_its_own(rig: Rig) -> None:
    """left.max_gap is 50 s, front has the node's 5 s."""
    assert rig.probe.set("left.max_gap", 60.0).successful
    for camera in BOTH:
        rig.play(camera, frames(1))
    rig.now += 20.0
    stamps = {camera: rig.send(camera, frames(1)[0]) for camera in BOTH}
    assert rig.reset_at("front", stamps["front"])[0] == "gap between stamps"
    rig.depth("left", stamps["left"])
    assert stamps["left"] not in map(stamp_of, rig.probe.received["left/resets"])


def test_a_camera_s_own_value_can_be_given_later(rig: Rig) -> None:
    """A whole number does for a DOUBLE; what is refused is not there afterwards."""
    for name, value in {
        "front.nothing": 1,
        "front.cameras": 1,
        "front.queue_size": 5,  # of the whole node
        "left.points_stride": -1,
        "left.min_depth": "near",
        "left.image_transport": "compressed",  # while the node is configured
        "left.distortion": "maybe",
        "nobody.max_gap": 1,
    }.items():
        result = rig.probe.set(name, value)
        assert not result.successful, name
        assert name.partition(".")[2] in result.reason or "parameter type" in result.reason
    listed = rig.probe.call(ListParameters, "list_parameters", ListParameters.Request()).result
    assert not {name for name in listed.names if name.startswith("front.")}
    assert {name for name in listed.names if name.startswith("left.")} == {
        "left.max_gap",
        "left.reliability",
        "left.device",
    }
    for value in (30, 31.0):
        assert rig.probe.set("front.max_gap", value).successful
    for camera in BOTH:
        rig.play(camera, frames(1))
    rig.now += 20.0
    stamp = rig.send("front", frames(1)[0])
    rig.depth("front", stamp)
    assert stamp not in map(stamp_of, rig.probe.received["front/resets"])
    assert rig.probe.set("front.max_gap", 5).successful
    assert rig.probe.set("max_depth", 5).successful
    assert not rig.probe.set("max_depth", -5).successful
    assert rig.probe.set("max_depth", 0).successful


def test_a_rate_thins_out_the_images_by_their_stamps(rig: Rig) -> None:
    rig.play("front", frames(1))
    assert rig.probe.set("front.max_rate", 5).successful
    rig.now += 1.0
    stamps = [rig.send("front", frames(1)[0], 0.1) for _ in range(9)]
    rig.depth("front", stamps[-1])
    done = set(map(stamp_of, rig.probe.received["front/depth/image"]))
    assert [stamp in done for stamp in stamps] == [True, False] * 4 + [True]
    assert rig.probe.set("front.max_rate", 0).successful
    assert rig.diagnostics()["stream_depth: front"][1]["skipped by max_rate"] == "4"


def test_outputs_can_be_smaller_than_the_image(rig: Rig) -> None:
    topics = {"front/depth/camera_info": CameraInfo, "front/points": PointCloud2}
    for topic, kind in topics.items():
        if not rig.probe.received[topic]:
            rig.probe.listen(topic, kind)
    rig.probe.wait(
        lambda: (rig.play("front", frames(1)), all(rig.probe.received[t] for t in topics))[1]
    )
    rig.reset()
    whole = as_depth(rig.play("front", frames(1))[0])
    assert rig.probe.set("front.output_scale", 0.5).successful
    rig.reset()
    stamp = rig.send("front", frames(1)[0])
    small = rig.message("front/depth/image", stamp)
    assert (small.height, small.width) == (18, 24)
    depth = as_depth(bytes(small.data), 18, 24)
    assert np.array_equal(depth, whole[1::2, 1::2], equal_nan=True)
    info = rig.message("front/depth/camera_info", stamp)
    cloud = cloud_points(rig.message("front/points", stamp))
    assert (info.height, info.width) == cloud.shape == (18, 24)
    matrix = np.reshape(info.k, (3, 3))
    valid = np.isfinite(cloud["z"])
    assert valid.any()
    rows, columns = np.nonzero(valid)
    for axis, index, pixels in (("x", 0, columns), ("y", 1, rows)):
        projected = cloud[axis] / cloud["z"] * matrix[index, index] + matrix[index, 2]
        np.testing.assert_allclose(projected[valid], pixels, atol=1e-3)
    assert rig.probe.set("front.output_scale", 1).successful


def test_the_share_of_valid_pixels_is_published_and_a_low_one_is_a_problem(rig: Rig) -> None:
    ratios = rig.probe.listen("front/valid_ratio", Float32)
    rig.probe.wait(lambda: (rig.play("front", frames(1)), ratios)[1])
    depth = as_depth(rig.play("front", frames(1))[0])
    rig.probe.wait(lambda: ratios[-1].data == np.float32(np.isfinite(depth).mean()))
    assert rig.probe.set("front.min_depth", 1e5).successful

    def said() -> bool:
        assert np.isnan(as_depth(rig.play("front", frames(1))[0])).all()
        message, values = rig.diagnostics()["stream_depth: front"]
        return "0.0% of the depth is valid" in message and values["valid ratio"] == "0.000"

    rig.probe.wait(said)
    assert rig.probe.set("front.min_depth", 0).successful


def test_there_is_nothing_to_calibrate_without_measurements(rig: Rig) -> None:
    for name in ("calibrate", "left/calibrate"):
        answer = rig.probe.trigger(name)
        assert not answer.success
        assert "left: metric_source is 'none', which measures nothing" in answer.message


def test_the_log_level_can_be_set(rig: Rig) -> None:
    level = LoggerLevel(name="stream_depth", level=LoggerLevel.LOG_LEVEL_INFO)
    request = SetLoggerLevels.Request(levels=[level])
    assert rig.probe.call(SetLoggerLevels, "set_logger_levels", request).results[0].successful


def test_another_node_of_the_same_name_is_a_problem(rig: Rig) -> None:
    twin = rclpy.create_node("stream_depth", context=rig.probe.context)
    text = "1 other node is called /stream_depth too"
    rig.probe.wait(lambda: text in rig.diagnostics()["stream_depth"][0])
    twin.destroy_node()
    rig.node.wait_log(rf"WARN\].*{text}")


def test_an_unknown_lens_costs_the_intrinsics_only(rig: Rig) -> None:
    info = camera_info()
    info.distortion_model, info.d = "of_a_stranger", [0.1, 0.2, 0.3]
    rig.probe.publish("/left/camera_info", stamped(info, 1))
    reason = "'of_a_stranger' with 3 coefficients cannot be undone"

    def warned() -> bool:
        rig.play("left", frames(1))
        return reason in rig.node.log

    rig.probe.wait(warned)
    rig.reset()
    assert_close(as_depth(rig.play("left", frames(1))[0]), alone(frames(1))[0])


def test_small_steps_back_are_no_reset(rig: Rig) -> None:
    rig.play("front", frames(1))
    stamps = [rig.send("front", frames(1)[0], step) for step in (-0.1, 0.2)]
    for stamp in stamps:
        rig.depth("front", stamp)
    assert not set(stamps) & set(map(stamp_of, rig.probe.received["front/resets"]))


def test_diagnostics_tell_the_state_of_the_node_and_of_each_camera(rig: Rig) -> None:
    rig.play("front", frames(2))
    found = rig.diagnostics()
    assert list(found) == ["stream_depth", "stream_depth: front", "stream_depth: left"]
    values = found["stream_depth"][1]
    assert (values["model"], values["state"], values["device"]) == ("tiny", "active", "cpu")
    hardware = {s.name: s.hardware_id for s in rig.probe.received["/diagnostics"][-1].status}
    assert hardware["stream_depth: left"] == "/left/image"
    assert hardware["stream_depth"].endswith(" cpu")
    front = found["stream_depth: front"][1]
    assert front["image topic"] == "/front/image"
    assert int(front["published"]) >= 2
    assert front["processing p50"].endswith(" ms")
    assert float(front["processing p99"].split()[0]) >= float(front["processing p50"].split()[0])
    assert "not of this node's clock" in rig.diagnostics()["stream_depth: front"][0]


def test_a_silent_camera_and_a_bad_image_are_problems_in_diagnostics(rig: Rig) -> None:
    rig.probe.wait(lambda: "no images on /left/image" in rig.diagnostics()["stream_depth: left"][0])
    rig.probe.publish("/left/image", stamped(image_message(frames(1)[0], "jello"), 1))
    rig.probe.wait(lambda: "could not be used" in rig.diagnostics()["stream_depth: left"][0])


def test_an_incompatible_subscriber_is_named_in_diagnostics(rig: Rig) -> None:
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    rig.probe.listen("left/points", PointCloud2, latched)
    text = f"{NODE}/left/points: 1 x a subscriber with incompatible QoS (DURABILITY)"
    rig.probe.wait(lambda: text in rig.diagnostics()["stream_depth"][0])


def test_an_incompatible_publisher_is_named_in_diagnostics(rig: Rig) -> None:
    unreliable = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    rig.probe.node.create_publisher(Image, "/left/image", unreliable)
    text = "/left/image: 1 x a publisher with incompatible QoS (RELIABILITY)"
    rig.probe.wait(lambda: text in rig.diagnostics()["stream_depth"][0])


def test_sixteen_bits_are_thousandths_with_zero_for_none(rig: Rig) -> None:
    expected = as_depth(rig.play("front", frames(1))[0])
    assert rig.probe.set("depth_encoding", "16UC1").successful
    rig.reset()
    message = rig.message("front/depth/image", rig.send("front", frames(1)[0]))
    assert rig.probe.set("depth_encoding", "32FC1").successful
    assert (message.encoding, message.step) == ("16UC1", 96)
    values = np.frombuffer(message.data, "<u2").reshape(36, 48)
    assert np.array_equal(values == 0, np.isnan(expected) | (expected < 0.0005))
    np.testing.assert_allclose(values[values > 0] / 1000, expected[values > 0], atol=0.00051)


def test_colours_and_compressed_depth_show_the_depth(rig: Rig) -> None:
    topics = {"front/depth/colored": Image, "front/depth/image/compressedDepth": CompressedImage}
    for topic, kind in topics.items():
        rig.probe.listen(topic, kind)
    rig.probe.wait(
        lambda: (rig.play("front", frames(1)), all(rig.probe.received[t] for t in topics))[1]
    )
    stamp = rig.send("front", frames(1)[0])
    depth = as_depth(rig.depth("front", stamp))
    colored, packed = (rig.message(topic, stamp) for topic in topics)
    assert (colored.encoding, colored.height, colored.width) == ("rgb8", 36, 48)
    rgb = np.frombuffer(colored.data, np.uint8).reshape(36, 48, 3)
    assert (rgb[np.isnan(depth)] == rgb[np.isnan(depth)][0]).all()
    assert len(np.unique(rgb[~np.isnan(depth)], axis=0)) > 10
    assert packed.format == "32FC1; compressedDepth png"
    unpacked = decode_compressed_depth(packed)
    inside = ~np.isnan(unpacked)
    assert inside.mean() > 0.3
    assert np.isnan(unpacked[np.isnan(depth)]).all()
    np.testing.assert_allclose(unpacked[inside], depth[inside], rtol=0.02)


def test_cloud_filters_thin_crop_and_cut_edges(rig: Rig) -> None:
    rig.probe.listen("front/points", PointCloud2)
    rig.probe.wait(lambda: (rig.play("front", frames(1)), rig.probe.received["front/points"])[1])
    rig.reset()
    depth = as_depth(rig.play("front", frames(1))[0])
    near, far = (float(x) for x in np.nanquantile(depth, [0.1, 0.9]))
    wanted = {
        "points_stride": 3,
        "points_min_depth": near,
        "points_max_depth": far,
        "points_edge_filter": 0.1,
    }
    for name in sorted(wanted, reverse=True):
        assert rig.probe.set(name, wanted[name]).successful
    rig.reset()
    stamp = rig.send("front", frames(1)[0])
    cloud = cloud_points(rig.message("front/points", stamp))
    assert np.array_equal(as_depth(rig.depth("front", stamp)), depth, equal_nan=True)
    for name in ("points_min_depth", "points_max_depth", "points_edge_filter"):
        assert rig.probe.set(name, 0.0).successful
    assert rig.probe.set("points_stride", 1).successful
    keep = (depth >= near) & (depth <= far)
    cut = flying_pixels(depth, keep, 0.1)
    assert 0 < cut.sum() < keep.sum()
    expected = np.where(keep & ~cut, depth, np.nan)[1::3, 1::3]
    assert cloud.shape == (12, 16)
    assert np.array_equal(cloud["z"], expected, equal_nan=True)


def test_a_distorted_lens_is_undone_or_refused(rig: Rig) -> None:
    info = camera_info()
    info.d = [-0.2, 0.05, 0.0, 0.0, 0.0]
    rig.probe.listen("front/depth/camera_info", CameraInfo)
    rig.probe.publish("/front/camera_info", stamped(info, 1))
    matrix = np.reshape(info.k, (3, 3))

    def in_force() -> bool:
        stamp = rig.send("front", frames(1)[0])
        got = rig.message("front/depth/camera_info", stamp)
        return np.array_equal(np.reshape(got.k, (3, 3)), matrix) and not any(got.d)

    rig.play("front", frames(1))
    rig.probe.wait(in_force)
    rig.reset()
    image = frames(1)[0]
    got = as_depth(rig.play("front", [image])[0])
    from dyfn_ros.messages.rectify import Rectifier, RectifyRules

    view = Rectifier(print).view(image, "optical", info, RectifyRules())
    assert view.visible is not None
    expected = np.where(view.visible, alone([view.image], matrix)[0], np.nan)
    assert_close(got, expected)

    assert rig.probe.set("distortion", "refuse").successful
    rig.send("front", image)
    rig.node.wait_log(r"WARN\].*/front/image: the lens is distorted .*refuse")
    assert rig.probe.set("distortion", "ignore").successful
    rig.reset()
    got = as_depth(rig.play("front", [image])[0])
    assert_close(got, alone([image], matrix)[0])
    assert rig.probe.set("distortion", "undistort").successful


def test_a_camera_info_of_another_frame_is_not_used(rig: Rig) -> None:
    rig.probe.publish("/left/camera_info", stamped(camera_info(), 1, frame_id="elsewhere"))
    reason = "frame_id is 'elsewhere', but the images have 'optical'"

    def warned() -> bool:
        rig.play("left", frames(1))
        return reason in rig.node.log

    rig.probe.wait(warned)
    rig.reset()
    expected = alone(frames(1))[0]
    assert_close(as_depth(rig.play("left", frames(1))[0]), expected)
