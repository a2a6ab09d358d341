"""The bundled model by the real command lines: the node's depth over DDS is the replay's.

dyfn-replay and stream_depth run as processes of their own, with their defaults.
"""

import hashlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from dyfn_ros.demo.node_process import NodeProcess
from dyfn_ros.messages.images import decode_depth
from dyfn_ros.node.environment import prepare_environment
from dyfn_ros.recordings.open import RecordedFrame, open_recording
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording
from dyfn_ros.recordings.typestore import IMAGE, TYPES
from tests.support.ros_graph import DEADLINE, own_domain

pytestmark = pytest.mark.slow

COUNT, SIZE = 12, (240, 320)
CAMERA = np.array([[260.0, 0, 159.5], [0, 260.0, 119.5], [0, 0, 1]])


def walk() -> list[FrameToRecord]:
    """A window that moves over a large picture of blobs and stripes, and grows darker."""
    rng = np.random.default_rng(5)
    large = cv2.resize(rng.integers(0, 255, (30, 44, 3), np.uint8), (700, 480))
    large[::16] //= 2
    found = []
    for index in range(COUNT):
        y, x = 6 * index, 17 * index
        image = (large[y : y + SIZE[0], x : x + SIZE[1]] * (1 - 0.04 * index)).astype(np.uint8)
        found.append(FrameToRecord(image, None, CAMERA, None, 50 + index / 15))
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`walk`, and `rest`: its second half alone."""
    made = tmp_path_factory.mktemp("recordings")
    write_rgbd_recording(made / "walk", walk())
    write_rgbd_recording(made / "rest", walk()[COUNT // 2 :])
    return made


@pytest.fixture(scope="module")
def offline(folder: Path) -> dict[str, Path]:
    """Recording -> folder of its results, by one command line."""
    command = [
        sys.executable,
        "-m",
        "dyfn_ros.replay.cli",
        str(folder / "walk"),
        str(folder / "rest"),
    ]
    options = ["--out", str(folder / "offline"), "--write", "raw"]
    subprocess.run([*command, *options], check=True, stdout=subprocess.DEVNULL, timeout=DEADLINE)
    return {name: folder / "offline" / name for name in ("walk", "rest")}


@pytest.fixture(scope="module")
def online(folder: Path) -> Iterator[dict[str, list[bytes]]]:
    """The depth of every frame of three passes through one node."""
    prepare_environment()
    frames = list(open_recording(folder / "walk").frames())
    kind = frames[0].source.kind
    parameters = {
        "drop_frames": False,  # so that subscriptions are reliable
        "wait_for_camera_info": True,
        "image_transport": "compressed",
    }
    with own_domain() as domain, pytest.MonkeyPatch.context() as patch:
        for name, value in domain.items():
            patch.setenv(name, value)
        from dyfn_ros.demo.live_player import LivePlayer

        number = int(domain["ROS_DOMAIN_ID"])
        with (
            NodeProcess(folder / "node.log", parameters, environment=domain) as node,
            LivePlayer(node, kind, number) as player,
        ):
            player.prime(frames[0])

            def passed(some: list[RecordedFrame]) -> list[bytes]:
                player.reset(stabilize=True)
                return [result.depth.tobytes() for result in player.play(some)]

            half = COUNT // 2
            yield {
                "whole": passed(frames),
                "first": passed(frames[:half]),
                "rest": passed(frames[half:]),
            }


def depth_bytes(out: Path) -> list[bytes]:
    with (out / "output.mcap").open("rb") as file:
        return [
            decode_depth(TYPES.deserialize_cdr(message.data, IMAGE)).tobytes()
            for _, _, message in make_reader(file).iter_messages("/stream_depth/depth/image")
        ]


def test_every_frame_is_answered_with_the_bytes_of_the_replay(
    online: dict[str, list[bytes]], offline: dict[str, Path]
) -> None:
    assert len(online["whole"]) == COUNT
    assert online["whole"] == depth_bytes(offline["walk"])
    found = json.loads((offline["walk"] / "metrics.json").read_text())
    assert found["stabilizer"] is True and found["model"] == "dyfn-mini"
    assert hashlib.sha256(b"".join(online["whole"])).hexdigest() == found["output_sha256"]


def test_after_a_reset_in_the_middle_it_is_the_replay_of_the_rest(
    online: dict[str, list[bytes]], offline: dict[str, Path]
) -> None:
    half = COUNT // 2
    assert online["first"] == online["whole"][:half]
    assert online["rest"] == depth_bytes(offline["rest"])
    assert online["rest"] != online["whole"][half:]  # the state matters
