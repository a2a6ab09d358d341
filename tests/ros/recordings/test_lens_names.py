"""frame_ids with a slash in front, and names of lens models of other tools."""

from pathlib import Path

import numpy as np
import pytest

from dyfn_ros.messages.rectify import is_rectified
from dyfn_ros.recordings.open import Recording, open_recording
from dyfn_ros.recordings.typestore import CAMERA_INFO, Lens, camera_info
from dyfn_ros.recordings.writer import RecordingWriter
from tests.support.numbered import CAMERA, SECOND, SIZE, depth, numbers, picture

COUNT = 3
FOUR = (-0.1, 0.01, 0.001, 0.002)


def write(
    path: Path,
    lens: Lens | None = None,
    frames: tuple[str, str, str] = ("camera", "camera", "camera"),
) -> Recording:
    """frames: frame_ids of image, CameraInfo and depth."""
    with RecordingWriter(path) as writer:
        for index in range(COUNT):
            stamp = SECOND + index * SECOND // 10
            info = camera_info(CAMERA, SIZE, stamp, frames[1], lens)
            writer.write("/camera/camera_info", CAMERA_INFO, info, stamp)
            writer.write_image("/camera/image", picture(index), stamp, frames[0])
            if lens is None:
                writer.write_depth("/camera/depth", depth(index), stamp, frames[2])
    return open_recording(path)


@pytest.mark.parametrize(
    "frames",
    [
        ("cam", "/cam", "cam"),
        ("/cam", "cam", "cam"),
        ("/cam", "/cam", "cam"),
        ("robot/cam", "/robot/cam", "/robot/cam"),
    ],
)
def test_a_slash_before_a_frame_makes_no_other_frame(
    tmp_path: Path, frames: tuple[str, str, str]
) -> None:
    recording = write(tmp_path / "bag", frames=frames)
    found = list(recording.frames())
    assert all(frame.camera_matrix is not None for frame in found)
    assert numbers(found) == [*range(COUNT)]
    assert not recording.notes.warnings


def test_another_frame_is_another_frame(tmp_path: Path) -> None:
    recording = write(tmp_path / "bag", frames=("cam", "/cam/left", "cam"))
    assert all(frame.camera_matrix is None for frame in recording.frames())
    (text,) = recording.notes.warnings
    assert "frame_id is '/cam/left', but the images have 'cam'" in text


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("radtan", "plumb_bob"),
        ("RadTan", "plumb_bob"),
        ("radial-tangential", "plumb_bob"),
        ("kannala_brandt", "equidistant"),
        ("Kannala Brandt4", "equidistant"),
        ("fisheye", "equidistant"),
        ("equi", "equidistant"),
    ],
)
def test_other_names_of_a_lens_are_the_same_lens(tmp_path: Path, name: str, known: str) -> None:
    recording = write(tmp_path / "other", Lens(name, FOUR))
    found = list(recording.frames())
    expected = list(write(tmp_path / "known", Lens(known, FOUR)).frames())
    assert len(found) == len(expected) == COUNT and not recording.notes.losses
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
    assert not np.array_equal(found[0].image, picture(0))


@pytest.mark.parametrize(
    ("name", "coefficients"),
    [
        ("Brown Conrady", (0.1, -0.02, 0, 0, 0)),
        ("", (0.1, -0.02, 0, 0, 0)),
        ("kannala_brandt", (0.1, 0, 0, 0, 0)),
        ("inverse_brown_conrady", (0.1, 0, 0, 0, 0)),
    ],
)
def test_an_unknown_lens_costs_the_intrinsics_only_as_in_the_node(
    tmp_path: Path, name: str, coefficients: tuple[float, ...]
) -> None:
    recording = write(tmp_path / "bag", Lens(name, coefficients))
    found = list(recording.frames())
    assert not recording.notes.losses
    (text,) = recording.notes.warnings
    assert "cannot be undone; known: plumb_bob (radtan), " in text
    assert text.endswith("; going on without intrinsics")
    without = open_recording(tmp_path / "bag", camera_info_topic="none")
    for one, other in zip(found, without.frames(), strict=True):
        assert one.camera_matrix is None and other.camera_matrix is None
        np.testing.assert_array_equal(one.image, other.image)


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/camera/image_rect", True),
        ("/camera/image_rect_color/compressed", True),
        ("/camera/rectified/image", True),
        ("/rect_left/image", True),
        ("/camera/image_raw", False),
        ("/camera/rectangle/image", False),
        ("/rectified/camera/image_raw", False),
        ("/camera/correct_image", False),
    ],
)
def test_what_is_rectified_is_told_by_its_name(topic: str, rectified: bool) -> None:
    assert is_rectified(topic) == rectified


@pytest.mark.parametrize(
    ("name", "projected", "d", "focal"),
    [
        ("image_rect", 30.0, FOUR, 30.0),
        ("image_rect", 0.0, (), 40.0),  # of a driver that leaves P empty and has no lens
        ("image_rect", 0.0, FOUR, None),
        ("image_raw", 30.0, (), 40.0),
    ],
)
def test_a_rectified_image_has_the_intrinsics_of_p(
    tmp_path: Path, name: str, projected: float, d: tuple[float, ...], focal: float | None
) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        info = camera_info(CAMERA, SIZE, SECOND, "camera", Lens("plumb_bob", d))
        info.p = info.p * np.array([projected / 40, 1, 1, 1, 1, projected / 40, *([1] * 6)])
        if projected == 0:
            info.p = np.zeros(12)
        writer.write("/camera/camera_info", CAMERA_INFO, info, SECOND)
        writer.write_image(f"/camera/{name}", picture(0), SECOND, "camera")
    recording = open_recording(tmp_path / "bag")
    (frame,) = recording.frames()
    np.testing.assert_array_equal(frame.image, picture(0))
    assert (frame.camera_matrix is None) == (focal is None)
    if frame.camera_matrix is not None:
        assert frame.camera_matrix[0, 0] == frame.camera_matrix[1, 1] == focal
    assert any("P[0] is 0" in text for text in recording.notes.warnings) == (focal is None)
