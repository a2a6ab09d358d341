"""Distorted lenses undone, and the CameraInfos that are not used."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from dyfn_ros.messages.camera_info import decode_camera_info, resized_camera_info
from dyfn_ros.messages.images import MessageError
from dyfn_ros.messages.rectify import PinholeImage, Rectifier, RectifyRules, undistort_depth

HEIGHT, WIDTH = 60, 80
K = np.array([[70.0, 0, 41.0], [0, 72.0, 28.0], [0, 0, 1]])
LENSES = {
    "plumb_bob": [-0.25, 0.06, 0.002, -0.001, 0.0],
    "rational_polynomial": [0.3, 0.1, 0.001, 0.0, 0.02, 0.6, 0.2, 0.03],
    "equidistant": [0.05, -0.02, 0.01, 0.0],
}


def info(model: str = "plumb_bob", d: list[float] | None = None, **fields: Any) -> CameraInfo:
    return CameraInfo(
        header=Header(frame_id=fields.pop("frame_id", "optical")),
        height=HEIGHT,
        width=WIDTH,
        distortion_model=model,
        d=[0.0] * 5 if d is None else d,
        k=K.reshape(-1).tolist(),
        **fields,
    )


def distorted(model: str, d: list[float], rays: np.ndarray) -> np.ndarray:
    """N x 2 view-plane points -> N x 2 pixels, by the projection that OpenCV has for the lens."""
    points = np.column_stack([rays, np.ones(len(rays))])[:, None]
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    return project(points, np.zeros(3), np.zeros(3), K, np.array(d))[0][:, 0]


def ramp(pixels: np.ndarray) -> np.ndarray:
    """A picture that says where each of its pixels is: R = 2 u, G = 3 v."""
    u, v = pixels[..., 0], pixels[..., 1]
    return np.stack([2 * u, 3 * v, np.full_like(u, 7)], axis=-1)


def view(message: CameraInfo, **rules: Any) -> tuple[PinholeImage, list[str]]:
    warnings: list[str] = []
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    image = ramp(np.stack([u, v], axis=-1)).astype(np.uint8)
    calibrator = Rectifier(warnings.append)
    return calibrator.view(image, "optical", message, RectifyRules(**rules)), warnings


@pytest.mark.parametrize("model", LENSES)
def test_each_pixel_shows_what_its_pinhole_ray_sees_through_the_lens(model: str) -> None:
    got, warnings = view(info(model, LENSES[model]))
    assert not warnings
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1).reshape(-1, 2)
    source = distorted(model, LENSES[model], rays).reshape(HEIGHT, WIDTH, 2)
    assert got.visible is not None
    assert 0.5 < got.visible.mean() <= 1
    inner = (source >= 0).all(-1) & (source[..., 0] <= WIDTH - 1) & (source[..., 1] <= HEIGHT - 1)
    assert (got.visible | ~inner).all()
    assert np.abs(got.image.astype(float) - ramp(source))[inner].max() <= 1.0
    assert np.abs(source - np.stack([u, v], axis=-1)).max() > 1  # it is a lens
    assert np.array_equal(got.matrix, K)
    assert got.info is None  # the camera's own no longer describes the image


def test_depth_goes_the_way_of_its_image_also_at_another_size() -> None:
    got, _ = view(info("plumb_bob", LENSES["plumb_bob"]))
    _, u = np.mgrid[: 2 * HEIGHT, : 2 * WIDTH].astype(np.float32)
    depth = undistort_depth(u / 2 - 0.25, got)  # says the column in the image's pixels
    half = depth.reshape(HEIGHT, 2, WIDTH, 2).mean((1, 3))
    assert got.visible is not None
    known = got.visible & np.isfinite(half)
    assert known.mean() > 0.9
    assert np.abs(half - got.image[..., 0] / 2)[known].max() < 1.0
    plain = np.ones((3, 4), np.float32)
    assert undistort_depth(plain, PinholeImage(got.image)) is plain


def test_a_pinhole_passes_through_untouched() -> None:
    message = info()
    got, warnings = view(message)
    assert (got.info, got.visible, got.lens, warnings) == (message, None, None, [])


def test_distortion_can_be_refused_or_ignored() -> None:
    message = info("plumb_bob", LENSES["plumb_bob"])
    with pytest.raises(MessageError, match=r"distorted .* refuse"):
        view(message, distortion="refuse")
    got, warnings = view(message, distortion="ignore")
    assert got.info is message
    assert got.visible is None
    assert "ignored" in warnings[0]


@pytest.mark.parametrize(
    ("model", "count"), [("ellipsoidal", 4), ("equidistant", 5), ("plumb_bob", 3), ("ocam", 2)]
)
def test_a_lens_that_is_not_known_costs_the_intrinsics_by_name(model: str, count: int) -> None:
    message = info(model, [0.1] * count)
    found, warnings = view(message)
    assert (found.matrix, found.info, found.visible) == (None, None, None)
    assert f"'{model}' with {count} coefficients cannot be undone" in warnings[0]
    with pytest.raises(MessageError, match="parameter distortion is refuse"):
        view(message, distortion="refuse")


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"frame_id": "other"}, "frame_id is 'other', but the images have 'optical'"),
        ({"binning_x": 2}, "is for 40 x 60 pixels"),
    ],
)
def test_a_camera_info_of_something_else_costs_the_intrinsics(
    fields: dict[str, Any], reason: str
) -> None:
    got, warnings = view(info(**fields))
    assert got.matrix is None
    assert reason in warnings[0]
    assert "going on without intrinsics" in warnings[0]


def test_the_frame_id_may_be_left_unchecked() -> None:
    got, _ = view(info(frame_id="other"), check_frame_id=False)
    assert np.array_equal(got.matrix, K)
    assert view(info(frame_id=""))[0].matrix is not None


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"d": [float("nan"), 0.0, 0.0, 0.0, 0.0]}, "no finite numbers"),
        ({"d": [float("inf"), 0.0, 0.0, 0.0, 0.0]}, "no finite numbers"),
        ({"d": [1e6, 0.0, 0.0, 0.0, 0.0]}, "of no real lens"),
        ({"focal": 1e30}, "of no real camera"),
        ({"focal": 1e-30}, "of no real camera"),
        ({"centre": 1e9}, "of no real camera"),
    ],
)
def test_nonsense_costs_the_intrinsics_and_is_said(change: dict[str, Any], reason: str) -> None:
    focal, centre = change.get("focal", 40.0), change.get("centre", 24.0)
    nonsense = SimpleNamespace(
        header=SimpleNamespace(frame_id="optical"),
        width=48,
        height=36,
        k=[focal, 0.0, centre, 0.0, focal, 18.0, 0.0, 0.0, 1.0],
        d=change.get("d", [0.0] * 5),
        distortion_model="plumb_bob",
        binning_x=0,
        binning_y=0,
        roi=SimpleNamespace(width=0, height=0, x_offset=0, y_offset=0),
    )
    said: list[str] = []
    image = np.full((36, 48, 3), 9, np.uint8)
    found = Rectifier(said.append).view(image, "optical", nonsense, RectifyRules())
    assert found.matrix is None and found.visible is None
    np.testing.assert_array_equal(found.image, image)
    assert len(said) == 1 and reason in said[0]


@pytest.mark.parametrize("size", [(30, 40), (15, 20), (20, 26), (1, 1)])
def test_camera_info_of_a_smaller_image_sees_the_same_rays(size: tuple[int, int]) -> None:
    """Also of an image that is a binned region of the sensor."""
    message = info(p=[70.0, 0, 41, -7, 0, 72, 28, 3.5, 0, 0, 1, 0])
    message.height, message.width, message.binning_x, message.binning_y = 200, 300, 2, 3
    roi = message.roi
    roi.x_offset, roi.y_offset, roi.width, roi.height = 11, 5, 160, 180
    before = decode_camera_info(message, HEIGHT, WIDTH)
    small = resized_camera_info(message, *size)
    after = decode_camera_info(small, *size)
    factors = np.array([size[1] / WIDTH, size[0] / HEIGHT])
    corners = np.array([[-0.5, -0.5], [WIDTH - 0.5, HEIGHT - 0.5], [12.0, 7.0]])
    rays = (corners - before.matrix[:2, 2]) / before.matrix[[0, 1], [0, 1]]
    found = rays * after.matrix[[0, 1], [0, 1]] + after.matrix[:2, 2]
    np.testing.assert_allclose(found, factors * (corners + 0.5) - 0.5, atol=1e-9)
    p = np.reshape(small.p, (3, 4))
    np.testing.assert_allclose(p[:2, :3], after.matrix[:2], atol=1e-9)
    np.testing.assert_allclose(p[:2, 3], [-7 / 2 * factors[0], 3.5 / 3 * factors[1]])
    assert (message.height, message.roi.x_offset, message.k[2]) == (200, 11, K[0, 2])
