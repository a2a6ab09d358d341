"""Ground truth of another camera or of a point cloud, in the pixels of the image."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dyfn_core.geometry.projection import back_project, render_depth, resized_camera
from dyfn_ros.messages.compressed_depth import encode_compressed_depth
from dyfn_ros.messages.references import Transform
from dyfn_ros.recordings.ground_truth import register_depth
from dyfn_ros.recordings.open import RecordedFrame, RecordingError, open_recording
from dyfn_ros.recordings.typestore import (
    COMPRESSED_IMAGE,
    POINT_CLOUD,
    TYPES,
    compressed_message,
    header,
)
from dyfn_ros.recordings.writer import RecordingWriter

COLOUR, SIZE = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]), (48, 64)
DEPTH, DEPTH_SIZE = np.array([[30.0, 0, 24.0], [0, 32.0, 20.0], [0, 0, 1]]), (41, 52)
IMAGE = np.full((*SIZE, 3), 90, np.uint8)
STAMP = 5_000_000_000


def plane(matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Depth of the plane z = 2 + 0.5 x, which is 1 / z = (1 - 0.5 x / z) / 2."""
    u = np.arange(size[1])
    z = 2 / (1 - 0.5 * (u - matrix[0, 2]) / matrix[0, 0])
    return np.broadcast_to(z, size).astype(np.float32)


def test_a_point_falls_into_its_pixel_and_the_nearest_is_seen() -> None:
    points = np.array([[0, 0, 4.0], [0, 0, 3.0], [1, 0, 2.0], [0, 0, -1.0], [np.nan, 0, 1.0]])
    depth = render_depth(points, COLOUR, SIZE)
    assert np.isfinite(depth).sum() == 2
    assert depth[24, 32] == 3.0  # halves go up
    assert depth[24, 62] == 2.0
    np.testing.assert_allclose(back_project(depth, COLOUR)[:, 2], [3, 2])


def test_resized_intrinsics_keep_the_corners_of_the_image() -> None:
    small = resized_camera(COLOUR, SIZE, (24, 32))
    for edge in (-0.5, 63.5):
        ray = (edge - COLOUR[0, 2]) / COLOUR[0, 0]
        assert ray * small[0, 0] + small[0, 2] == pytest.approx((edge + 0.5) / 2 - 0.5)


def test_depth_is_registered_by_intrinsics() -> None:
    truth = register_depth(plane(DEPTH, DEPTH_SIZE), DEPTH, COLOUR, SIZE)
    assert truth.shape == (24, 32)  # no finer than the depth
    expected = plane(resized_camera(COLOUR, SIZE, truth.shape), truth.shape)
    seen = np.isfinite(truth)
    assert seen.mean() > 0.8
    np.testing.assert_allclose(truth[seen], expected[seen], rtol=0.02)


def test_registration_over_a_baseline_shows_the_nearer_surface() -> None:
    depth = np.full((40, 40), 4.0, np.float32)
    depth[:, :20] = 1.0
    camera = np.array([[20.0, 0, 19.5], [0, 20.0, 19.5], [0, 0, 1]])
    moved = Transform(np.eye(3), np.array([0.5, 0, 0]))  # the depth camera is 0.5 m to the right
    truth = register_depth(depth, camera, camera, (40, 40), moved)
    # By 0.5 * 20 / z pixels: the near half by 10 to the right, over the far one, which moves 2.5.
    assert (truth[20, 10:30] == 1.0).all()
    assert (truth[20, 30:40] == 4.0).all()
    assert np.isnan(truth[20, :10]).all()


def write(path: Path, **changes: Any) -> None:
    """A colour and a depth camera, with a CameraInfo each."""
    wanted = {"info": True, "frame": "depth", "kind": "16UC1", **changes}
    with RecordingWriter(path) as writer:
        writer.write_image("/color/image", IMAGE, STAMP, "color")
        writer.write_camera_info("/color/camera_info", COLOUR, SIZE, STAMP, "color")
        depth = plane(DEPTH, DEPTH_SIZE)
        if wanted["kind"] == "compressedDepth":
            layout, data = encode_compressed_depth(depth, depth > 0, "32FC1")
            made = compressed_message(np.frombuffer(data, np.uint8), layout, STAMP, "depth")
            writer.write("/depth/image/compressedDepth", COMPRESSED_IMAGE, made, STAMP)
        else:
            writer.write_depth("/depth/image", depth, STAMP, wanted["frame"], wanted["kind"])
        if wanted["info"]:
            writer.write_camera_info("/depth/camera_info", DEPTH, DEPTH_SIZE, STAMP, "depth")


def frame(path: Path, **options: Any) -> tuple[RecordedFrame, dict[str, int], dict[str, int]]:
    recording = open_recording(path, **options)
    (only,) = recording.frames()
    return only, recording.notes.warnings, recording.notes.losses


@pytest.mark.parametrize("kind", ["16UC1", "32FC1", "png", "compressedDepth"])
def test_a_depth_camera_of_its_own_is_registered(tmp_path: Path, kind: str) -> None:
    write(tmp_path / "bag", kind=kind)
    found, warnings, losses = frame(tmp_path / "bag")
    assert found.depth is not None and found.depth.shape == (24, 32)
    expected = plane(resized_camera(COLOUR, SIZE, (24, 32)), (24, 32))
    seen = np.isfinite(found.depth)
    np.testing.assert_allclose(found.depth[seen], expected[seen], rtol=0.03)
    assert not losses
    assert list(warnings) == [
        f"/depth/image{'/compressedDepth' if kind == 'compressedDepth' else ''}"
        ": frame 'depth' taken to be at the image's "
        "optical centre ('color'): no transform given"
    ]


def test_a_transform_moves_the_depth(tmp_path: Path) -> None:
    write(tmp_path / "bag")
    straight, _, _ = frame(tmp_path / "bag")
    moved, warnings, _ = frame(tmp_path / "bag", depth_transform="0 0 0.25 0 0 0 1")
    assert not warnings
    difference = np.nanmedian(moved.depth) - np.nanmedian(straight.depth)
    assert difference == pytest.approx(0.25, abs=0.05)
    with pytest.raises(ValueError, match="depth_transform is '1 2', expected seven numbers"):
        open_recording(tmp_path / "bag", depth_transform="1 2")


def test_depth_without_intrinsics_of_its_own_is_registered_already(tmp_path: Path) -> None:
    write(tmp_path / "bag", info=False, frame="color")
    found, warnings, _ = frame(tmp_path / "bag")
    assert found.depth is not None and found.depth.shape == DEPTH_SIZE and not warnings
    with pytest.raises(RecordingError, match="needs the CameraInfo of /depth/image"):
        open_recording(tmp_path / "bag", depth_transform="0 0 0 0 0 0 1")


def write_cloud(path: Path, points: np.ndarray) -> None:
    field = TYPES.types["sensor_msgs/msg/PointField"]
    cloud = TYPES.types[POINT_CLOUD](
        header=header(STAMP + 1000, "lidar"),
        height=1,
        width=len(points),
        fields=[field(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")],
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(points),
        data=np.ascontiguousarray(points, "<f4").view(np.uint8).reshape(-1),
        is_dense=True,
    )
    with RecordingWriter(path) as writer:
        writer.write_image("/color/image", IMAGE, STAMP, "color")
        writer.write_camera_info("/color/camera_info", COLOUR, SIZE, STAMP, "color")
        writer.write("/lidar", POINT_CLOUD, cloud, STAMP + 1000)


def test_a_point_cloud_is_truth_when_it_is_named(tmp_path: Path) -> None:
    # x forward, y left, z up, as lidars have it; the quaternion turns it into optical axes.
    write_cloud(tmp_path / "bag", np.array([[3.0, 0, 0], [5.0, 0, 0], [2.0, -0.5, 0], [-1, 0, 0]]))
    assert frame(tmp_path / "bag")[0].depth is None
    turned = "0 0 0 0.5 -0.5 0.5 0.5"
    options = {"depth_topic": "/lidar", "depth_transform": turned}
    found, warnings, losses = frame(tmp_path / "bag", **options)
    assert found.depth is not None and not warnings and not losses
    assert {tuple(p) for p in np.argwhere(np.isfinite(found.depth))} == {(24, 32), (24, 47)}
    assert found.depth[24, 32] == 3.0 and found.depth[24, 47] == 2.0
    far = frame(tmp_path / "bag", **options, tolerance=1e-7)
    assert far[0].depth is None and "/lidar: no depth at an image's stamp" in far[1]
    unknown = frame(tmp_path / "bag", **options, camera_info_topic="none")
    assert "needs the intrinsics" in next(iter(unknown[2]))


def test_stamps_of_recording_by_option(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        from dyfn_ros.recordings.typestore import IMAGE as KIND
        from dyfn_ros.recordings.typestore import image_message

        for index in range(3):
            message = image_message(IMAGE, "rgb8", 0, "camera")  # a driver without a clock
            writer.write("/image", KIND, message, STAMP + index)
    recording = open_recording(tmp_path / "bag")
    assert [f.stamp_ns for f in recording.frames()] == [0, 0, 0]
    recording = open_recording(tmp_path / "bag", stamps="log")
    assert [f.stamp_ns for f in recording.frames()] == [STAMP, STAMP + 1, STAMP + 2]
    assert not recording.notes.warnings
