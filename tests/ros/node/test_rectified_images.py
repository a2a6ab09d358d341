"""Images that are rectified by their topic's name: P holds, live as in dyfn-replay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, PointCloud2

from dyfn_ros.messages.clouds import cloud_points
from dyfn_ros.recordings.open import open_recording
from dyfn_ros.recordings.typestore import CAMERA_INFO, Lens
from dyfn_ros.recordings.typestore import camera_info as recorded_info
from dyfn_ros.recordings.writer import RecordingWriter
from tests.support.node_here import running_node
from tests.support.probe import Probe, stamp_of, stamped
from tests.support.ros_graph import NODE, camera_info, frames, image_message, own_domain

K, P = 40.0, 30.0  # focal lengths, pixels
D = [-0.2, 0.05, 0.0, 0.0, 0.0]
SECOND = 1_000_000_000


def focal_of_cloud(message: PointCloud2) -> float:
    """By the x / z of neighbours of a row."""
    points = cloud_points(message)
    slopes = points["x"] / points["z"]
    return float(1 / np.nanmedian(np.diff(slopes, axis=1)))


def live(topic: str, info: CameraInfo) -> tuple[float, list[float]]:
    """Focal length of the cloud, and D of its CameraInfo."""
    remap = ["-r", f"/image:={topic}", "-r", "/camera_info:=/cam/camera_info"]
    with own_domain() as domain, running_node(domain, remap):
        probe = Probe(domain)
        clouds, infos = (
            probe.listen(f"{NODE}/{name}", kind)
            for name, kind in (("points", PointCloud2), ("depth/camera_info", CameraInfo))
        )
        stamps = iter(range(10_000))

        def described() -> bool:  # the last cloud, by a CameraInfo
            return bool(clouds and infos) and stamp_of(clouds[-1]) == stamp_of(infos[-1])

        def answered() -> bool:
            now = SECOND + next(stamps) * SECOND // 30
            probe.publish("/cam/camera_info", stamped(info, now))
            probe.publish(topic, stamped(image_message(frames(1)[0]), now))
            probe.spin_until(described, 0.5)
            return described() and any(infos[-1].k)

        try:
            probe.wait(answered)
            return focal_of_cloud(clouds[-1]), list(infos[-1].d)
        finally:
            probe.close()


def offline(folder: Path, topic: str) -> float:
    matrix = np.reshape(camera_info(focal=K).k, (3, 3))
    image = frames(1)[0]
    info = recorded_info(matrix, image.shape[:2], SECOND, "optical", Lens("plumb_bob", tuple(D)))
    info.p[0] = P
    with RecordingWriter(folder / "bag") as writer:
        writer.write("/cam/camera_info", CAMERA_INFO, info, SECOND)
        writer.write_image(topic, image, SECOND, "optical")
    (frame,) = open_recording(folder / "bag").frames()
    assert frame.camera_matrix is not None
    return float(frame.camera_matrix[0, 0])


@pytest.mark.parametrize(
    ("topic", "focal", "lens"),
    [("/cam/image_rect", P, D), ("/cam/rect/image", P, D), ("/cam/image_raw", K, [0.0] * 5)],
)
def test_p_holds_where_the_name_says_so(
    tmp_path: Path, topic: str, focal: float, lens: list[float]
) -> None:
    info = camera_info(focal=K)
    info.d, info.p[0] = D, P
    found, left = live(topic, info)
    assert found == pytest.approx(focal, rel=0.01)
    assert left == lens
    assert offline(tmp_path, topic) == focal
