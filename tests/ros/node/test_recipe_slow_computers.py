"""The recipes for slow computers and for GPUs: less work by each setting, devices by camera."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from dyfn_core.models.mini import MiniConfig, MiniModel
from dyfn_ros.messages.camera_info import resized_matrix
from dyfn_ros.messages.images import decode_depth
from tests.support.node_here import SUCCESS, made_node
from tests.support.probe import stamp_of, stamped
from tests.support.recipe_scene import SIZE, Scene, camera_matrix, mount, picture, scene_depth
from tests.support.recipe_stream import (
    OPTICAL_FRAME,
    RECIPES,
    RecipeStream,
    parameters_of,
    recipe_stream,
)
from tests.support.ros_graph import image_message, own_domain

SLOW = RECIPES / "stream_depth_slow.yaml"
GPUS = RECIPES / "stream_depth_two_gpus.yaml"
KINDS = {"depth/image": Image, "depth/camera_info": CameraInfo, "points": PointCloud2}
IMAGE = "/camera/image_raw"
DEPTH = scene_depth(Scene(), mount(height=1.0, down=15))


@pytest.fixture(scope="module")
def stream() -> Iterator[RecipeStream]:
    with recipe_stream(SLOW) as stream:
        yield stream


def test_every_output_is_smaller_and_of_the_same_scene(stream: RecipeStream) -> None:
    answer = stream.frame(picture(DEPTH), KINDS)
    half = SIZE[0] // 2, SIZE[1] // 2
    depth = decode_depth(answer["depth/image"])
    assert depth.shape == half
    inside = np.s_[:, 2:-2]
    truth = DEPTH.reshape(half[0], 2, half[1], 2)
    low, high = truth.min(axis=(1, 3)) - 0.01, truth.max(axis=(1, 3)) + 0.01  # of its four pixels
    assert ((depth >= low) & (depth <= high))[inside].mean() > 0.95
    info = answer["depth/camera_info"]
    assert (info.height, info.width) == half
    expected = resized_matrix(camera_matrix(), (0.5, 0.5))
    np.testing.assert_allclose(np.array(info.k).reshape(3, 3), expected)
    cloud = answer["points"]
    assert (cloud.height, cloud.width) == (half[0] // 2, half[1] // 2)


def test_images_are_thinned_out_to_the_rate(stream: RecipeStream) -> None:
    """Two seconds of a camera of 30 Hz."""
    stream.frame(picture(DEPTH), KINDS)
    camera = stream.node._cameras[0]
    before = Counter(camera.statistics.counts)
    start = stream.stamp + 10**9
    for number in range(60):
        stamp = start + number * 33_333_333
        stream.probe.publish(IMAGE, stamped(image_message(picture(DEPTH)), stamp, OPTICAL_FRAME))
        stream.probe.spin_until(lambda: False, 0.005)
    counts = camera.statistics.counts
    stream.probe.wait(lambda: counts["received"] - before["received"] == 60, 20.0)
    taken = 60 - (counts["skipped"] - before["skipped"])
    rate = stream.node.settings.max_rate
    assert taken == pytest.approx(2 * rate, abs=1)
    depths = stream.probe.received["depth/image"]
    stream.probe.wait(lambda: stamp_of(depths[-1]) >= start + 1_600_000_000, 20.0)


def test_fewer_tokens_are_fewer_pixels_in_the_network() -> None:
    """Of a model as the bundled one is: its own resolution is 192 tokens."""
    model = MiniModel(MiniConfig(latent_channels=8, stage_channels=(8,), context_layers=0))
    own, tokens = model.settings.num_tokens, parameters_of(SLOW, "stream_depth")["num_tokens"]
    assert (own, tokens) == (192, 128)
    pixels = [np.prod(model.network_size((480, 640), count)) for count in (None, tokens)]
    assert pixels[1] / pixels[0] == pytest.approx(tokens / own, abs=0.1)


def test_a_camera_whose_gpu_is_not_there_is_named(capfd: pytest.CaptureFixture[str]) -> None:
    with own_domain() as domain, made_node(domain, ["--params-file", str(GPUS)]) as node:
        assert [node._table.camera(name).device for name in ("front", "rear")] == [
            "cuda:0",
            "cuda:1",
        ]
        found = node.trigger_configure()
    if torch.cuda.device_count() > 1:
        assert found == SUCCESS
        return
    assert found != SUCCESS
    missing = "rear" if torch.cuda.is_available() else "front"
    assert f"cannot configure: {missing}: " in capfd.readouterr().err
