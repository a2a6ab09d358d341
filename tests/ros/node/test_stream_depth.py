"""The node in a process of its own, over DDS on loopback."""

from __future__ import annotations

import array
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, Image

from dyfn_core.stream.depth_stream import DepthStream
from dyfn_ros.messages import images as messages
from dyfn_ros.messages.camera_info import decode_camera_info
from dyfn_ros.messages.clouds import cloud_points
from tests.core.stream.test_scene_cut import scene, seen
from tests.support.made_pictures import png
from tests.support.ros_graph import (
    DEADLINE,
    NODE,
    Client,
    Gate,
    NodeProcess,
    camera_info,
    frames,
    image_message,
    own_domain,
    tiny_node,
)
from tests.support.tiny_model import BLOCKING, FAILING, load_tiny


class Graph:
    """A domain with a node and a client, which end with the test."""

    def __init__(self, domain: dict[str, str], folder: Path) -> None:
        self.gate = Gate(folder)
        self._domain, self._folder = domain, folder
        self._nodes: list[NodeProcess] = []
        self._clients: list[Client] = []

    def start(self, **parameters: Any) -> NodeProcess:
        node = tiny_node({**self._domain, **self.gate.environment}, self._folder, **parameters)
        self._nodes.append(node)
        return node

    @property
    def node(self) -> NodeProcess:
        return self._nodes[-1]

    def connect(self, **options: Any) -> Client:
        client = Client(self._domain, **options)
        self._clients.append(client)
        return client

    def close(self) -> None:
        for client in self._clients:
            client.close()
        for node in self._nodes:
            node.kill()
        self.gate.close()


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    with own_domain() as domain:
        graph = Graph(domain, tmp_path)
        yield graph
        graph.close()


@pytest.fixture(scope="module")
def lossless(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[NodeProcess, Client]]:
    """One node that works on every frame, for all tests that leave it as it was."""
    with own_domain() as environment:
        node = tiny_node(environment, tmp_path_factory.mktemp("node"), drop_frames=False)
        client = Client(environment)
        client.prime()
        yield node, client
        client.close()
        code = node.end()
        assert code == 0, node.log


@pytest.fixture
def client(lossless: tuple[NodeProcess, Client]) -> Client:
    """The node is restarted, without a usable CameraInfo."""
    lossless[1].send_info(camera_info(focal=0.0))
    lossless[1].prime()
    lossless[1].reset()
    return lossless[1]


def play(client: Client, images: list[np.ndarray]) -> list[dict[str, Any]]:
    stamps = [client.send(image) for image in images]
    return [client.result(stamp) for stamp in stamps]


def calibrate(client: Client, **options: Any) -> np.ndarray:
    """Send a CameraInfo and wait until it is in force; -> its matrix."""
    info = camera_info(**options)
    client.send_info(info)
    matrix = np.reshape(info.k, (3, 3))

    def in_force() -> bool:
        shape = (options.get("height", 36), options.get("width", 48))
        result = client.result(client.send(frames(1, *shape)[0]))
        return np.array_equal(np.reshape(result["depth/camera_info"].k, (3, 3)), matrix)

    client.wait(in_force)
    client.reset()
    return matrix


def depth_bytes(results: list[dict[str, Any]]) -> list[bytes]:
    return [bytes(r["depth/image"].data) for r in results]


def offline(
    images: list[np.ndarray], matrix: np.ndarray | None = None, stabilize: bool = True
) -> list[bytes]:
    """The depth images that DepthStream gives in this process, on one thread as the node."""
    model = load_tiny()
    if not stabilize:
        model.stabilizer = None
    stream = DepthStream(model, camera_matrix=matrix)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    predictions = [stream.push(image) for image in images]
    torch.set_num_threads(threads)
    return [torch.where(p.mask, p.depth, torch.nan).numpy().tobytes() for p in predictions]


def test_outputs_have_the_header_and_size_of_the_input(client: Client) -> None:
    stamp = client.send(frames(1)[0])
    result = client.result(stamp)
    for message in result.values():
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (
            stamp,
            500_000_000 + stamp,
        )
        assert message.header.frame_id == "optical"
        assert (message.height, message.width) == (36, 48)
    assert result["depth/image"].encoding == "32FC1"
    assert result["points"].is_dense is False


def test_depth_is_positive_or_nan_and_never_zero(client: Client) -> None:
    result = play(client, frames(1))[0]
    raw = np.frombuffer(result["depth/image"].data, "<f4")
    assert np.isnan(raw).any()
    assert np.isfinite(raw).any()
    assert (raw[~np.isnan(raw)] > 0).all()
    assert np.isfinite(raw[~np.isnan(raw)]).all()


@pytest.mark.parametrize("size", [(36, 48), (37, 51)])
def test_cloud_projects_back_onto_its_pixels(client: Client, size: tuple[int, int]) -> None:
    matrix = calibrate(client, height=size[0], width=size[1])
    image = frames(1, *size)[0]
    result = play(client, [image])[0]
    cloud = cloud_points(result["points"])
    xyz = np.stack([cloud[axis] for axis in "xyz"], axis=2).astype(np.float64)
    valid = np.isfinite(xyz).all(axis=2)
    assert 0.3 < valid.mean() < 1
    projected = xyz[valid] @ matrix.T
    v, u = np.nonzero(valid)
    assert np.abs(projected[:, 0] / projected[:, 2] - u).max() < 1e-2
    assert np.abs(projected[:, 1] / projected[:, 2] - v).max() < 1e-2
    depth = messages.decode_depth(result["depth/image"])
    assert np.array_equal(cloud["z"], depth, equal_nan=True)
    colours = np.ascontiguousarray(cloud["rgb"]).view(np.uint32)
    assert np.array_equal(colours >> 16, image[..., 0])
    assert np.array_equal((colours >> 8) & 255, image[..., 1])
    assert np.array_equal(colours & 255, image[..., 2])


def test_camera_info_passes_through_with_the_image_header(client: Client) -> None:
    calibrate(client)
    stamp = client.send(frames(1)[0])
    info = client.result(stamp)["depth/camera_info"]
    expected = camera_info()
    expected.header = info.header
    assert info == expected
    assert (info.header.stamp.sec, info.header.frame_id) == (stamp, "optical")


def test_without_calibration_the_cloud_fits_the_estimated_camera(client: Client) -> None:
    result = play(client, frames(1))[0]
    info = result["depth/camera_info"]
    matrix = decode_camera_info(info, 36, 48).matrix
    cloud = cloud_points(result["points"])
    xyz = np.stack([cloud[axis] for axis in "xyz"], axis=2).astype(np.float64)
    valid = np.isfinite(xyz).all(axis=2)
    projected = xyz[valid] @ matrix.T
    v, u = np.nonzero(valid)
    assert np.abs(projected[:, 0] / projected[:, 2] - u).max() < 1e-2
    assert np.abs(projected[:, 1] / projected[:, 2] - v).max() < 1e-2


def test_after_a_reset_the_same_frames_give_the_same_bytes(client: Client) -> None:
    images = frames(4)
    first = depth_bytes(play(client, images))
    assert depth_bytes(play(client, images)) != first  # the state matters
    assert client.reset().success
    assert depth_bytes(play(client, images)) == first


@pytest.mark.parametrize("calibrated", [False, True])
def test_online_equals_offline(client: Client, calibrated: bool) -> None:
    matrix = calibrate(client) if calibrated else None
    images = frames(5, seed=3)
    assert depth_bytes(play(client, images)) == offline(images, matrix)


def test_every_frame_of_a_burst_is_answered_in_order(client: Client) -> None:
    client.order.clear()
    stamps = [client.send(image) for image in frames(60)]
    client.wait(lambda: len(client.order) >= 60)
    assert client.order == stamps


def bad_images() -> dict[str, tuple[Image, str]]:
    good = frames(1)[0]
    unknown = image_message(good, encoding="jello")
    step = image_message(good)
    step.step = 100
    short = image_message(good)
    short.data = array.array("B", bytes(1000))
    empty = Image(encoding="rgb8")
    return {
        "unknown": (unknown, r"'jello' is not known"),
        "step": (step, r"step is 100 bytes, but a row of 48 pixels of rgb8 has 144"),
        "short": (short, r"data has 1000 bytes, but 36 rows of step 144"),
        "zero": (empty, r"the image is 0 x 0 pixels"),
    }


@pytest.mark.parametrize("kind", bad_images())
def test_a_bad_image_is_named_and_the_next_good_one_works(
    lossless: tuple[NodeProcess, Client], client: Client, kind: str
) -> None:
    message, reason = bad_images()[kind]
    bad = client.send_message(message)
    client.result(client.send(frames(1)[0]))
    assert not client.received[bad]
    lossless[0].wait_log(rf"WARN\].*/image: .*{reason}")


def test_an_exception_in_inference_costs_one_frame(
    lossless: tuple[NodeProcess, Client], client: Client
) -> None:
    first = depth_bytes(play(client, frames(2)))
    failing = frames(1)[0].copy()
    failing[0, 0] = FAILING
    bad = client.send(failing)
    assert depth_bytes(play(client, frames(2))) == first  # the stream was reset
    assert not client.received[bad]
    lossless[0].wait_log(r"ERROR\].*/image: inference failed.*RuntimeError: the picture that must")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"focal": 0.0}, r"uncalibrated: K\[0\] is 0"),
        ({"width": 64}, "is for 64 x 36 pixels, but the images have 48 x 36"),
    ],
)
def test_an_unusable_camera_info_is_named_and_ignored(
    lossless: tuple[NodeProcess, Client], client: Client, options: Any, reason: str
) -> None:
    plain = depth_bytes(play(client, frames(2)))
    client.send_info(camera_info(**options))
    for _ in range(3):
        client.reset()
        assert depth_bytes(play(client, frames(2))) == plain
    lossless[0].wait_log(rf"WARN\].*/camera_info: {reason}")


def test_twelve_bits_in_sixteen_are_said_and_can_be_told(
    lossless: tuple[NodeProcess, Client], client: Client
) -> None:
    grey = frames(1)[0][..., 0]
    expected = play_one(client, image_message(np.repeat(grey[..., None], 3, axis=2)))
    values = np.rint(grey * (4095 / 255)).astype("<u2")
    twelve = Image(height=36, width=48, encoding="mono16", step=96)
    twelve.data = array.array("B", values.tobytes())
    client.reset()
    assert play_one(client, twelve) != expected
    lossless[0].wait_log(r"WARN\].*/image: the values of 'mono16' are below 4096.*image_bits:=12")
    assert client.set_parameter("image_bits", 12).successful
    client.reset()
    assert play_one(client, twelve) == expected
    assert client.set_parameter("image_bits", 16).successful


def play_one(client: Client, message: Image) -> bytes:
    return bytes(client.result(client.send_message(message))["depth/image"].data)


def test_another_resolution_resets_the_stream(client: Client) -> None:
    first = depth_bytes(play(client, frames(2)))
    other = play(client, frames(1, 24, 32))[0]["depth/image"]
    assert (other.height, other.width) == (24, 32)
    assert depth_bytes(play(client, frames(2))) == first


def test_the_stabilizer_can_be_switched_off_and_on(client: Client) -> None:
    images = frames(3)
    with_state = depth_bytes(play(client, images))
    assert client.set_parameter("stabilize", False).successful
    assert depth_bytes(play(client, images)) == offline(images, stabilize=False) != with_state
    assert client.set_parameter("stabilize", True).successful
    assert depth_bytes(play(client, images)) == with_state


def test_range_limits_become_nan_in_depth_and_cloud(client: Client) -> None:
    full = messages.decode_depth(play(client, frames(1))[0]["depth/image"])
    near, far = (float(x) for x in np.nanquantile(full, [0.2, 0.8]))
    assert client.set_parameter("min_depth", near).successful
    assert client.set_parameter("max_depth", far).successful
    refused = client.set_parameter("min_depth", far + 1)
    assert (refused.successful, "must be below max_depth" in refused.reason) == (False, True)
    client.reset()
    result = play(client, frames(1))[0]
    assert client.set_parameter("min_depth", 0.0).successful
    assert client.set_parameter("max_depth", 0.0).successful
    expected = np.where((full >= near) & (full <= far), full, np.nan)
    assert np.array_equal(messages.decode_depth(result["depth/image"]), expected, equal_nan=True)
    assert np.array_equal(cloud_points(result["points"])["z"], expected, equal_nan=True)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("cameras", ["front"], "read.only"),
        ("model", "other", "only while the node is unconfigured"),
        ("drop_frames", True, "only while the node is unconfigured"),
        ("distortion", "maybe", "expected one of"),
        ("num_tokens", -5, "range"),
        ("stabilize", "yes", "type"),
    ],
)
def test_what_cannot_be_set_says_so(client: Client, name: str, value: Any, reason: str) -> None:
    result = client.set_parameter(name, value)
    assert not result.successful
    assert re.search(reason, result.reason, re.IGNORECASE), result.reason


def test_publishing_can_be_switched_off(client: Client) -> None:
    assert client.set_parameter("publish_points", False).successful
    stamp = client.send(frames(1)[0])
    client.wait(lambda: len(client.received[stamp]) == 2)
    assert client.set_parameter("publish_points", True).successful
    client.result(client.send(frames(1)[0]))
    assert set(client.received[stamp]) == {"depth/image", "depth/camera_info"}


def blocking_picture() -> np.ndarray:
    image = frames(1)[0].copy()
    image[0, 0] = BLOCKING
    return image


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Graph, Client]]:
    """One node that works on the latest frame only, fed as a camera driver would."""
    with own_domain() as domain:
        graph = Graph(domain, tmp_path_factory.mktemp("live"))
        node = graph.start()
        client = graph.connect(image_qos=qos_profile_sensor_data)
        client.prime()
        yield graph, client
        code = node.end(signal.SIGTERM)
        graph.close()
        assert code == 0, node.log


def test_a_reset_is_answered_during_inference_and_nothing_leaks_over_it(
    live: tuple[Graph, Client],
) -> None:
    graph, client = live
    client.prime()
    client.reset()
    expected = depth_bytes(play(client, frames(1)))

    in_flight = client.send(blocking_picture())
    graph.gate.wait_entered()
    waiting = [client.send(image) for image in frames(3, seed=5)]
    client.settle()
    response = client.reset()
    assert response.success
    assert "1 waiting frames dropped" in response.message
    after = client.send(frames(1)[0])
    client.settle()
    assert not client.received[in_flight]  # inference went on all the while

    graph.gate.open()
    assert depth_bytes([client.result(after)]) == expected
    client.result(in_flight)  # was worked on before the reset took effect
    assert not any(client.received[stamp] for stamp in waiting)


def test_only_the_latest_frame_waits(live: tuple[Graph, Client]) -> None:
    graph, client = live
    client.prime()
    first = client.send(blocking_picture())
    graph.gate.wait_entered()
    stamps = [client.send(image) for image in frames(5)]
    client.settle()
    client.order.clear()
    graph.gate.open()
    client.result(stamps[-1])
    assert client.order == [first, stamps[-1]]


def test_a_cut_among_dropped_frames_resets_the_stream_and_is_logged(
    live: tuple[Graph, Client],
) -> None:
    """A second of network time, in which ten pictures come; only the last is worked on."""
    graph, client = live
    client.prime()
    assert client.set_parameter("scene_cut_threshold", 0.6).successful
    client._stamp += 1
    pictures = [seen(scene(7 + index // 5), 4 * index) for index in range(10)]
    for index, picture in enumerate(pictures):
        message = image_message(cv2.resize(picture, (96, 72)))
        if index == 0:
            message.data[:3] = array.array("B", BLOCKING)
        message.header.frame_id = "optical"
        message.header.stamp.sec, message.header.stamp.nanosec = client._stamp, index * 10**8
        client.images.publish(message)
        if index == 0:
            graph.gate.wait_entered()
        client.spin_until(lambda: False, 0.16)
    client.settle()
    graph.gate.open()
    place = rf"/image: the stream is reset at {client._stamp}.\d00 s"
    graph.node.wait_log(rf"{place}: scene cut \(difference .* of 0.600\)")
    assert client.set_parameter("scene_cut_threshold", 0.0).successful


def test_depth_alone_is_built_for_its_subscriber_and_an_interrupt_waits_for_nobody(
    graph: Graph,
) -> None:
    """Interrupted in the middle of endless inference, the node still ends cleanly."""
    node = graph.start(drop_frames=False)
    client = graph.connect(subscribe=False)
    client.subscriptions.append(
        client.node.create_subscription(
            Image, f"{NODE}/depth/image", lambda m: client._take("depth/image", m), 10
        )
    )
    client.settle()
    while not client.order:  # until the node has seen the subscription
        client.send(frames(1)[0])
        client.spin_until(lambda: bool(client.order), 0.3)
    client.send(blocking_picture())
    graph.gate.wait_entered()
    assert node.end(signal.SIGINT) == 0
    assert "Traceback" not in node.log
    summary = r"(\d+) frames received, (\d+) worked on, (\d+) dropped, 0 bad, 0 failed"
    received, done, dropped = map(int, re.search(summary, node.log).groups())
    assert received == done + dropped + 1  # the one that never ends
    assert node.log.count("depth_message") > 0
    for other in ("cloud", "colour", "compressed", "normal"):
        assert f"{other}_message" not in node.log


def test_normals_of_a_model_that_has_them_go_to_their_subscriber(client: Client) -> None:
    matrix = calibrate(client)
    found: list[Image] = []
    subscription = client.node.create_subscription(Image, f"{NODE}/normal", found.append, 10)
    image = frames(1)[0]

    def came() -> bool:
        client.result(client.send(image))
        return bool(found)

    client.wait(came)
    client.node.destroy_subscription(subscription)
    message = found[-1]
    assert (message.encoding, message.height, message.width) == ("32FC3", 36, 48)
    normals = np.frombuffer(message.data, np.float32).reshape(36, 48, 3)
    stream = DepthStream(load_tiny(), camera_matrix=matrix)
    stream.normals = True
    wanted = stream.push(image)
    assert wanted.normal is not None
    # A first frame's mask; the node's stream is older, the direction of this model's rays is not.
    valid = np.isfinite(normals).all(axis=-1)
    assert valid.any()
    both = valid & wanted.mask.numpy()
    np.testing.assert_allclose(normals[both], wanted.normal.numpy()[both], atol=1e-5)


def test_compressed_images_and_waiting_for_camera_info(graph: Graph) -> None:
    """Frames that come before the CameraInfo are held, and then all have its intrinsics."""
    node = graph.start(
        image_transport="compressed",
        drop_frames=False,
        wait_for_camera_info=True,
        remap={"image": "/front/image"},
    )
    client = graph.connect(image_type=CompressedImage, image="/front/image")
    client.settle()
    images = frames(4)
    stamps = []
    for image in images:
        message = CompressedImage(format="bgr8; png compressed bgr8")
        data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
        message.data = array.array("B", data.tobytes())
        stamps.append(client.send_message(message))
    broken = CompressedImage(format="png", data=array.array("B", b"no picture"))
    client.send_message(broken)
    noisy = np.random.default_rng(0).integers(0, 256, (36, 48, 3), np.uint8)
    whole = cv2.imencode(".jpg", noisy)[1].tobytes()
    damaged = whole[: len(whole) // 2] + b"\xff\xd9"
    client.send_message(CompressedImage(format="jpeg", data=array.array("B", damaged)))
    bomb = CompressedImage(format="png", data=array.array("B", png(60_000, 60_000)))
    client.send_message(bomb)
    client.settle()
    assert not any(client.received[stamp] for stamp in stamps)
    client.send_info(camera_info())
    matrix = np.reshape(camera_info().k, (3, 3))
    assert depth_bytes([client.result(s) for s in stamps]) == offline(images, matrix)
    node.wait_log(r"WARN\].*/front/image/compressed: .*neither JPEG nor PNG")
    node.wait_log(r"WARN\].*/front/image/compressed: the JPEG is damaged: Corrupt JPEG data")
    assert not re.search(r"^Corrupt JPEG", node.log, re.MULTILINE)
    node.wait_log(r"WARN\].*/front/image/compressed: .*60000 x 60000 pixels; at most")
    assert node.end() == 0


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"model": "nothing"}, r"ERROR\].*cannot configure.*model 'nothing' is unknown"),
        ({"image_transport": "theora"}, r"stream_depth: .*image_transport is 'theora', expected"),
        ({"queue_size": 0}, r"stream_depth: .*queue_size out of range"),
        ({"queue_size": "many"}, r"stream_depth: .*'queue_size'.*expecting type 'INTEGER'"),
        ({"remap": {"image": "a//b"}}, r"stream_depth: .*Couldn't parse remap rule"),
        (
            {"qos_overrides./image.subscription.reliability": "some"},
            r"cannot configure: Unexpected QoS override for policy `reliability`: `some`",
        ),
    ],
)
def test_a_node_that_cannot_run_says_why_and_exits_with_one(
    graph: Graph, parameters: dict[str, Any], reason: str
) -> None:
    node = graph.start(**parameters)
    assert node.process.wait(DEADLINE) == 1
    assert re.search(reason, node.log), node.log
    assert "Traceback" not in node.log


def test_every_parameter_has_a_description(lossless: tuple[NodeProcess, Client]) -> None:
    from rcl_interfaces.srv import DescribeParameters

    from dyfn_ros.node.parameters.table import SPECS, START

    client = lossless[1]
    service = client.node.create_client(DescribeParameters, f"{NODE}/describe_parameters")
    described = client._call(service, DescribeParameters.Request(names=list(SPECS))).descriptors
    assert [d.name for d in described] == list(SPECS)
    assert all(d.description for d in described)
    assert {d.name for d in described if d.read_only} == {
        name for name, spec in SPECS.items() if spec.changes == START
    }
    types = {d.name: Parameter.Type(d.type) for d in described}
    assert types["model"] is Parameter.Type.STRING
    assert types["cameras"] is Parameter.Type.STRING_ARRAY
    assert types["num_tokens"] is Parameter.Type.INTEGER
