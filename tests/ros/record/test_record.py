"""dyfn-record: made recordings replay to the frames, stamps, intrinsics and depth of the source."""

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import yaml

from dyfn_ros.record.cli import ALL, PARTIAL, UNUSABLE, main
from dyfn_ros.recordings.open import RecordedFrame, open_recording
from dyfn_ros.recordings.poses import open_poses
from tests.support.made_benchmarks import over_colour
from tests.support.made_videos import make_video

H, W = 24, 32
STEREO_STAMPS = ("1305031102.175304", "1305031102.211214", "1305031103.275326")


def picture(index: int) -> np.ndarray:
    rng = np.random.default_rng(index)
    return cv2.resize(rng.integers(0, 255, (4, 5, 3), np.uint8), (W, H))


def millimetres(index: int) -> np.ndarray:
    depth = np.random.default_rng(100 + index).integers(400, 9000, (H, W)).astype(np.uint16)
    depth[0, :4] = 0
    return depth


def save(path: Path, rgb: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), rgb[..., ::-1] if rgb.ndim == 3 else rgb)


def pose(index: int) -> np.ndarray:
    angle, made = 0.3 * index, np.eye(4)
    made[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    made[:3, 3] = [index, 2, -0.5]
    return made


def plain(folder: Path) -> tuple[list[int], np.ndarray]:
    matrix = np.array([[30.5, 0, 15.25], [0, 31, 11.75], [0, 0, 1]])
    for i in range(3):
        save(folder / "rgb" / f"{i}.png", picture(i))
        save(folder / "depth" / f"{i}.png", millimetres(i))
    np.savetxt(folder / "K.txt", matrix)
    np.savetxt(folder / "poses.txt", np.array([pose(i).ravel() for i in range(3)]))
    return [0, 100_000_000, 200_000_000], matrix


def of_640_x_480(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Published intrinsics at the size of these images, which is a twentieth."""
    return np.array(
        [[fx / 20, 0, (cx + 0.5) / 20 - 0.5], [0, fy / 20, (cy + 0.5) / 20 - 0.5], [0, 0, 1]]
    )


def tum(folder: Path) -> tuple[list[int], np.ndarray]:
    rows: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for i, stamp in enumerate(STEREO_STAMPS):
        save(folder / "rgb" / f"{stamp}.png", picture(i))
        save(folder / "depth" / f"{stamp}.png", millimetres(i) * 5)
        for kind in ("rgb", "depth"):
            rows[kind].append(f"{stamp} {kind}/{stamp}.png")
        half = 0.15 * i
        rows["groundtruth"].append(f"{stamp} {i} 2 -0.5 0 0 {np.sin(half)} {np.cos(half)}")
    for kind, lines in rows.items():
        (folder / f"{kind}.txt").write_text("\n".join(["# a comment", *lines]))
    stamps = [int(text.replace(".", "")) * 1000 for text in STEREO_STAMPS]
    return stamps, of_640_x_480(517.3, 516.5, 318.6, 255.3)


def seven_scenes(folder: Path) -> tuple[list[int], np.ndarray]:
    for i, number in enumerate((0, 1, 3)):
        base = folder / f"frame-{number:06d}"
        save(base.with_name(f"{base.name}.color.png"), picture(i))
        save(base.with_name(f"{base.name}.depth.png"), millimetres(i))
        np.savetxt(base.with_name(f"{base.name}.pose.txt"), pose(i))
    stamps = [0, 33_333_333, 100_000_000]
    return stamps, of_640_x_480(525, 525, 320, 240)


def scannet(folder: Path) -> tuple[list[int], np.ndarray]:
    for i in range(3):
        save(folder / "color" / f"{i * 10}.png", picture(i))
        save(folder / "depth" / f"{i * 10}.png", millimetres(i))
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / "pose" / f"{i * 10}.txt", pose(i))
    matrix = np.array([[28.9, 0, 15.5], [0, 29, 11.5], [0, 0, 1]])
    four = np.eye(4)
    four[:3, :3] = matrix
    (folder / "intrinsic").mkdir()
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", four)
    return [0, 333_333_333, 666_666_667], matrix


def made(source: Path, out: Path, *options: object) -> list[RecordedFrame]:
    assert main([str(source), "--out", str(out), *map(str, options)]) == ALL
    return list(open_recording(out).frames())


@pytest.mark.parametrize(
    ("layout", "name", "options"),
    [
        (plain, "walk", ("--colour", "png")),
        (plain, "walk.mcap", ("--colour", "raw", "--depth", "png")),
        (tum, "walk.db3", ("--colour", "raw")),
        (seven_scenes, "walk", ("--colour", "png", "--storage", "sqlite3", "--depth", "32FC1")),
        (scannet, "walk.mcap", ("--colour", "png")),
    ],
)
def test_a_folder_comes_back_as_it_was(tmp_path: Path, layout, name, options) -> None:  # type: ignore[no-untyped-def]
    source = tmp_path / ("freiburg1_desk" if layout is tum else "room")
    stamps, matrix = layout(source)
    frames = made(source, tmp_path / name, *options)
    assert [frame.stamp_ns for frame in frames] == stamps
    where = open_poses(tmp_path / name, "camera_optical")
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, picture(index))
        stored = millimetres(index)
        expected = np.where(stored > 0, stored / np.float32(1000), np.nan)
        expected = over_colour(expected) if layout is seven_scenes else expected
        np.testing.assert_allclose(frame.depth, expected, rtol=1e-6)  # type: ignore[arg-type]
        np.testing.assert_allclose(frame.camera_matrix, matrix, rtol=1e-6)  # type: ignore[arg-type]
        found = where(index, frame.stamp_ns)
        np.testing.assert_allclose(found, pose(index), atol=1e-9)  # type: ignore[arg-type]


def raw_stream(path: Path, codec: str, container: str) -> Path:
    """Ten frames, grey of 20 x their index, without times."""
    with av.open(str(path), "w", format=container) as file:
        stream = file.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        for index in range(10):
            image = np.full((96, 128, 3), 20 * index, np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
        file.mux(stream.encode())
    return path


RAW_STREAMS = [("v.h264", "libx264", "h264"), ("v.265", "libx265", "hevc")]


@pytest.mark.parametrize(("name", "codec", "container"), RAW_STREAMS)
def test_a_video_without_times_needs_a_rate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, codec: str, container: str
) -> None:
    video = raw_stream(tmp_path / name, codec, container)
    assert wrong(tmp_path, video) == UNUSABLE
    assert "holds no times of its 10 frames" in (error := capsys.readouterr().err)
    assert "give --rate" in error
    assert not [path for path in tmp_path.iterdir() if path != video]
    frames = made(video, tmp_path / "walk.mcap", "--colour", "raw", "--rate", "20")
    assert [f.stamp_ns for f in frames] == [index * 50_000_000 for index in range(10)]
    assert [f.image.mean() for f in frames] == pytest.approx([20 * i for i in range(10)], abs=3)


@pytest.mark.parametrize("position", [1, 3, 9])
def test_one_repeated_time_costs_one_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], position: int
) -> None:
    times = [*range(10)]
    times[position:] = [time - 1 for time in times[position:]]
    path, base = tmp_path / "v.mkv", Fraction(1, 1000)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv444p"
        stream.codec_context.time_base = base
        for index, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 20 * index, np.uint8))
            frame.pts, frame.time_base = 100 * time, base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert wrong(tmp_path, path, "--colour", "raw") == PARTIAL
    said = f"1 frames whose time does not rise are left out (frame {position} at "
    assert said in capsys.readouterr().err
    frames = list(open_recording(tmp_path / "out").frames())
    assert [f.stamp_ns for f in frames] == [index * 100_000_000 for index in range(9)]
    shades = [20 * index for index in range(10) if index != position]
    assert [f.image.mean() for f in frames] == pytest.approx(shades, abs=2)


ODD_NAMES = ["walk #1", "walk #1.db3", "walk?.db3", "50%41", "a&b=c", "ünü.db3", "w%20.mcap"]


@pytest.mark.parametrize("name", ODD_NAMES)
@pytest.mark.parametrize("parent", [".", "data #2?%41"])
def test_names_that_mean_something_in_an_address(tmp_path: Path, name: str, parent: str) -> None:
    plain(tmp_path / "source")
    folder = tmp_path / "made" / parent
    folder.mkdir(parents=True)
    storage = [] if name.endswith((".db3", ".mcap")) else ["--storage", "sqlite3"]
    frames = made(tmp_path / "source", folder / name, "--colour", "png", *storage)
    assert len(frames) == 3
    np.testing.assert_array_equal(frames[2].image, picture(2))
    assert [*folder.iterdir()] == [folder / name]
    if storage:
        assert {f.name for f in (folder / name).iterdir()} == {"metadata.yaml", f"{name}.db3"}
    assert len([path for path in (tmp_path / "made").rglob("*") if path.is_file()]) == (
        2 if storage else 1
    )


def test_a_place_that_cannot_be_written_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain(tmp_path / "source")
    (tmp_path / "file").write_text("no folder")
    out = tmp_path / "file" / "walk.db3"
    assert main([str(tmp_path / "source"), "--out", str(out)]) == UNUSABLE
    assert f"{out}" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "source"]


CALIBRATION = {
    "image_width": 64,
    "image_height": 48,
    "camera_name": "cam",
    "camera_matrix": {"rows": 3, "cols": 3, "data": [60, 0, 31.5, 0, 61, 23.5, 0, 0, 1]},
    "distortion_model": "plumb_bob",
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": [-0.1, 0.01, 0, 0.002, 0]},
}


def test_a_video_keeps_the_times_of_its_frames(tmp_path: Path) -> None:
    times = [0, 0.04, 0.2, 0.25, 1.5]
    frames = made(make_video(tmp_path / "v.mp4", times), tmp_path / "walk.mcap", "--colour", "raw")
    assert [f.stamp_ns / 1e9 for f in frames] == pytest.approx(times, abs=2e-4)
    assert [f.image.mean() for f in frames] == pytest.approx([0, 20, 40, 60, 80], abs=2)
    assert all(f.camera_matrix is None and f.depth is None for f in frames)
    some = made(tmp_path / "v.mp4", tmp_path / "some", "--stride", "2", "--max-frames", "2")
    assert [f.stamp_ns / 1e9 for f in some] == pytest.approx([0, 0.2], abs=2e-4)


@pytest.mark.parametrize("by_file", [True, False])
def test_a_video_is_given_a_lens(tmp_path: Path, by_file: bool) -> None:
    make_video(tmp_path / "v.mp4", [0, 0.1])
    (tmp_path / "cam.yaml").write_text(yaml.safe_dump(CALIBRATION))
    numbers = [
        "--intrinsics",
        "60",
        "61",
        "31.5",
        "23.5",
        "--distortion",
        "-0.1",
        "0.01",
        "0",
        "0.002",
        "0",
    ]
    given = ["--camera-info", tmp_path / "cam.yaml"] if by_file else numbers
    frames = made(tmp_path / "v.mp4", tmp_path / "walk", *given)
    assert frames[0].info is not None
    info = frames[0].info.message()
    assert (info.distortion_model, info.d.tolist()) == ("plumb_bob", [-0.1, 0.01, 0, 0.002, 0])
    np.testing.assert_array_equal(info.k.reshape(3, 3), [[60, 0, 31.5], [0, 61, 23.5], [0, 0, 1]])
    assert frames[0].visible is not None  # the lens was taken out


def wrong(tmp_path: Path, *arguments: object) -> int:
    return main([*map(str, arguments), "--out", str(tmp_path / "out")])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image_width": 32}, "frames have 64 x 48 pixels, but the calibration is for 32 x 48"),
        ({"image_height": "48"}, "image_height: expected pixels"),
        ({"camera_matrix": {"data": [1, 2]}}, "camera_matrix: expected `data` of 9 numbers"),
        ({"distortion_coefficients": {"data": ["a"]}}, "distortion_coefficients: expected"),
    ],
)
def test_a_wrong_calibration_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict, message: str
) -> None:
    make_video(tmp_path / "v.mp4", [0])
    (tmp_path / "cam.yaml").write_text(yaml.safe_dump(CALIBRATION | change))
    arguments = (tmp_path / "v.mp4", "--camera-info", tmp_path / "cam.yaml")
    assert wrong(tmp_path, *arguments) == UNUSABLE
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_wrong_source_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert wrong(tmp_path, tmp_path / "nowhere") == UNUSABLE
    assert "nowhere does not exist" in capsys.readouterr().err
    (tmp_path / "text.mp4").write_text("no video")
    assert wrong(tmp_path, tmp_path / "text.mp4") == UNUSABLE
    assert "text.mp4: expected a video file" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert wrong(tmp_path, tmp_path / "empty") == UNUSABLE
    assert "expected one of: rgb.txt" in capsys.readouterr().err
    for name in ("one", "two"):
        seven_scenes(tmp_path / "scene" / name)
    assert wrong(tmp_path, tmp_path / "scene") == UNUSABLE
    assert "holds several folders" in capsys.readouterr().err
    assert wrong(tmp_path, tmp_path / "scene" / "one", "--distortion", "1") == UNUSABLE
    assert "are for videos" in capsys.readouterr().err


def test_what_is_left_out_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seven_scenes(tmp_path / "seq")
    (tmp_path / "seq" / "frame-000001.depth.png").unlink()
    assert wrong(tmp_path, tmp_path / "seq") == PARTIAL
    assert "image without depth" in capsys.readouterr().err
    assert len(list(open_recording(tmp_path / "out").frames())) == 2
    assert wrong(tmp_path, tmp_path / "seq") == UNUSABLE
    assert "exists already" in capsys.readouterr().err
