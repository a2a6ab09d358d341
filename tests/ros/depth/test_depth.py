"""dyfn-depth: every kind of source, what is written of it, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
from collections.abc import Callable
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import av
import cv2
import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image

from dyfn_core.data.files import read_exr, read_uint16
from dyfn_ros.depth import view
from dyfn_ros.depth.cli import ALL, INTERRUPTED, PARTIAL, UNUSABLE, main
from dyfn_ros.recordings.pictures import DIAGONAL_35MM, EXIF_IFD
from tests.support.made_videos import make_video, turn_right
from tests.support.tiny_model import FAILING, load_tiny

SIZE = (48, 64)


def noise(index: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    rng = np.random.default_rng(index)
    blocks = rng.integers(40, 215, (4, 5, 3), np.uint8)
    return cv2.resize(blocks, size[::-1], interpolation=cv2.INTER_LINEAR)


def save(path: Path, image: np.ndarray, exif: dict[int, Any] | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    made = Image.Exif()
    made.get_ifd(EXIF_IFD).update(exif or {})
    Image.fromarray(image).save(path, exif=made)
    return path


def run(*words: object, **given: Any) -> int:
    loader = lambda name, device: load_tiny()  # noqa: E731
    return main([*map(str, words)], loader=loader, **given)


def frames_of(path: Path) -> list[tuple[float, np.ndarray]]:
    """Seconds and picture of a video's frames."""
    with av.open(str(path)) as container:
        return [(f.time, f.to_ndarray(format="rgb24")) for f in container.decode(video=0)]


def kept(folder: Path) -> list[str]:
    """All files below a folder, also hidden ones."""
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def test_a_video_gets_its_depth_beside_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_video(tmp_path / "walk.mp4", [0, 0.1, 0.2], picture=noise)
    assert run(tmp_path / "walk.mp4") == ALL
    assert kept(tmp_path) == ["walk.mp4", "walk_depth.mp4"]
    for number, (time, picture) in enumerate(frames_of(tmp_path / "walk_depth.mp4")):
        assert time == pytest.approx(number / 10, abs=1e-3)
        assert picture.shape == (48, 128, 3)
        assert np.abs(picture[:, :60].astype(int) - noise(number)[:, :60]).mean() < 12
        assert picture[:, 68:].std() > 5  # colours of depth
    said = capsys.readouterr()
    assert "3 frames in" in said.out and "walk_depth.mp4" in said.out
    assert "camera: estimated by the model" in said.out
    assert "depth: right up to one scale, not in metres\n" in said.out
    assert "3/3" in said.err  # progress


def test_results_that_are_there_are_not_replaced_unasked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_video(tmp_path / "walk.mp4", [0])
    (tmp_path / "walk_depth.mp4").write_text("somebody's own")
    assert run(tmp_path / "walk.mp4") == UNUSABLE
    assert "walk_depth.mp4 exists already; expected --overwrite" in capsys.readouterr().err
    assert (tmp_path / "walk_depth.mp4").read_text() == "somebody's own"
    assert run(tmp_path / "walk.mp4", "--overwrite") == ALL
    assert len(frames_of(tmp_path / "walk_depth.mp4")) == 1  # one frame is a video too


def test_times_that_vary_stay(tmp_path: Path) -> None:
    times = [0, 0.033, 0.2, 0.25, 1.5]
    make_video(tmp_path / "v.mp4", times)
    assert run(tmp_path / "v.mp4", "--write", "video,npz") == ALL
    found = [time for time, _ in frames_of(tmp_path / "v_depth.mp4")]
    assert found == pytest.approx(times, abs=1e-3)
    stamps = [float(np.load(p)["seconds"]) for p in sorted((tmp_path / "v_depth/npz").iterdir())]
    assert stamps == pytest.approx(times, abs=1e-3)


def test_a_turned_video_of_a_phone_is_upright(tmp_path: Path) -> None:
    def bar(index: int, size: tuple[int, int]) -> np.ndarray:
        image = np.zeros((*size, 3), np.uint8)
        image[:, :16] = 255  # left, which is above once it is turned clockwise
        return image

    turn_right(make_video(tmp_path / "v.mp4", [0, 0.1], picture=bar))
    assert run(tmp_path / "v.mp4", "--write", "video,npz") == ALL
    assert np.load(tmp_path / "v_depth/npz/000000.npz")["depth"].shape == (64, 48)
    picture = frames_of(tmp_path / "v_depth.mp4")[0][1]
    assert picture.shape == (64, 96, 3)
    assert picture[:12, :44].min() > 200 and picture[22:, :44].max() < 50


@pytest.mark.parametrize("size", [(2160, 3840), (640, 360)])
def test_large_and_portrait_videos(tmp_path: Path, size: tuple[int, int]) -> None:
    make_video(tmp_path / "v.mp4", [0], size=size, picture=noise)
    assert run(tmp_path / "v.mp4", "--write", "video,png") == ALL
    assert read_uint16(tmp_path / "v_depth/png/000000.png").shape == size
    (picture,) = [picture for _, picture in frames_of(tmp_path / "v_depth.mp4")]
    height, width = (720, 1280) if size[1] == 3840 else size
    assert picture.shape == (height + 44, 2 * width, 3)


def test_pictures_give_depth_in_every_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(tmp_path / "photos" / "b 2.png", noise(1))
    save(tmp_path / "photos" / "a10.jpg", noise(2))
    formats = ("picture", "png", "npz", "exr", "ply")
    words = ("--out", tmp_path / "out", "--metric-source", "fixed", "--metric-scale", "0.5")
    assert run(tmp_path / "photos", "--write", ",".join(formats), *words) == ALL
    assert "depth: in metres\n" in capsys.readouterr().out
    out = tmp_path / "out" / "photos_depth"
    names = {kind: sorted(p.stem for p in (out / kind).iterdir()) for kind in formats}
    assert names == {kind: ["a10", "b 2"] for kind in formats}
    arrays = np.load(out / "npz" / "b 2.npz")
    depth, mask = arrays["depth"], arrays["mask"]
    assert depth.shape == SIZE and arrays["metric"] and np.isfinite(depth[mask]).all()
    np.testing.assert_array_equal(read_exr(out / "exr" / "b 2.exr"), depth)
    stored = read_uint16(out / "png" / "b 2.png")
    near = mask & (depth < 65.535)
    np.testing.assert_allclose(stored[near], 1000 * depth[near], atol=0.51)
    assert (stored[~near] == 0).all() and near.sum() > 1000
    points = np.asarray(trimesh.load(out / "ply" / "b 2.ply").vertices)
    assert 0 < len(points) <= mask.sum() and np.isin(points[:, 2], depth).all()
    facts = json.loads((tmp_path / "out" / "photos_depth.json").read_text())
    assert [one["name"] for one in facts["frames"]] == ["b 2", "a10"]  # by their numbers
    assert facts["png_values_per_unit"] == 1000 and all(one["metric"] for one in facts["frames"])


def test_a_picture_gives_a_picture(tmp_path: Path) -> None:
    save(tmp_path / "photo.jpg", noise(3))
    assert run(tmp_path / "photo.jpg") == ALL
    assert cv2.imread(str(tmp_path / "photo_depth.png")).shape == (48, 128, 3)
    assert run(tmp_path / "photo.jpg", "--write", "png,npz") == ALL
    assert read_uint16(tmp_path / "photo_depth16.png").shape == SIZE
    assert kept(tmp_path) == [
        *("photo.jpg", "photo_depth.json", "photo_depth.npz", "photo_depth.png"),
        "photo_depth16.png",
    ]


def test_a_folder_named_from_here_is_answered_from_here(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path / "photos" / "a.png", noise(1))
    monkeypatch.chdir(tmp_path)
    assert run("photos", "--write", "npz") == ALL
    assert capsys.readouterr().out.endswith("\nphotos_depth/npz\nphotos_depth.json\n")
    monkeypatch.chdir("photos")
    assert run(".", "--write", "npz", "--overwrite") == ALL
    assert kept(tmp_path) == ["photos/a.png", "photos_depth.json", "photos_depth/npz/a.npz"]


def test_depth_too_far_for_16_bits_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(tmp_path / "photo.png", noise(3))
    words = ("--write", "png", "--png-values", "1e6")
    assert run(tmp_path / "photo.png", *words) == ALL
    assert "16-bit PNGs end at a depth of 0.065535" in capsys.readouterr().err


def test_a_damaged_picture_costs_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(tmp_path / "photos" / "1.png", noise(1))
    (tmp_path / "photos" / "2.png").write_bytes(b"\x89PNG no more")
    (tmp_path / "photos" / "3.heic").write_bytes(b"anything")
    assert run(tmp_path / "photos", "--write", "npz") == PARTIAL
    said = capsys.readouterr().err
    assert "2.png: no such image, or a damaged one" in said
    assert "3.heic: .heic cannot be read, expected one of .jpg" in said
    assert [p.name for p in (tmp_path / "photos_depth/npz").iterdir()] == ["1.npz"]


def matrix_of(path: Path) -> np.ndarray:
    return np.asarray(np.load(path)["camera_matrix"])


FOCAL_35 = 26 / DIAGONAL_35MM * 80  # of 48 x 64 pixels, whose diagonal is 80
PLANE = {0x920A: 4.0, 0xA20E: 400.0, 0xA210: 3, 0xA002: 64}  # mm, per cm, pixels


@pytest.mark.parametrize(
    ("exif", "words", "focal", "told"),
    [
        ({0xA405: 26}, (), FOCAL_35, "EXIF of photo.jpg"),
        (PLANE, (), 160.0, "EXIF of photo.jpg"),
        ({0xA405: 26}, ("--fov", "90"), 32.0, "--fov 90"),
        ({}, ("--camera-matrix", "50", "51", "31", "23"), 50.0, "--camera-matrix 50 51 31 23"),
        ({0xA405: 26}, ("--no-exif",), None, "estimated by the model"),
        (PLANE | {0xA002: 4000}, (), None, "estimated by the model"),  # made smaller since
        ({0xA405: 0}, (), None, "estimated by the model"),
    ],
)
def test_the_camera_is_what_is_known_of_it(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    exif: dict[int, Any],
    words: tuple[str, ...],
    focal: float | None,
    told: str,
) -> None:
    save(tmp_path / "photo.jpg", noise(3), exif)
    assert run(tmp_path / "photo.jpg", "--write", "npz", *words) == ALL
    assert f"camera: {told}" in capsys.readouterr().out
    found = matrix_of(tmp_path / "photo_depth.npz")
    if focal is not None:
        assert found[0, 0] == pytest.approx(focal)
    if "--fov" in words:
        np.testing.assert_allclose(found, [[32, 0, 31.5], [0, 32, 23.5], [0, 0, 1]])


def test_the_lens_of_a_calibration_is_undone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_video(tmp_path / "v.mp4", [0], picture=noise)
    calibration = {
        "image_width": 64,
        "image_height": 48,
        "camera_matrix": {"data": [60, 0, 31.5, 0, 61, 23.5, 0, 0, 1]},
        "distortion_coefficients": {"data": [0.4, 0.1, 0, 0, 0]},
    }
    (tmp_path / "cam.yaml").write_text(yaml.safe_dump(calibration))
    words = ("--write", "video,npz", "--camera-matrix", tmp_path / "cam.yaml")
    assert run(tmp_path / "v.mp4", *words) == ALL
    arrays = np.load(tmp_path / "v_depth/npz/000000.npz")
    assert arrays["camera_matrix"][1, 1] == 61
    assert not arrays["mask"][0, 0]  # beyond what the lens saw
    np.savetxt(tmp_path / "K.txt", np.array([[60, 0, 310], [0, 60, 230], [0, 0, 1]]))
    words = ("--write", "npz", "--overwrite", "--camera-matrix", tmp_path / "K.txt")
    assert run(tmp_path / "v.mp4", *words) == UNUSABLE
    assert "cannot be intrinsics in pixels of images of 64 x 48" in capsys.readouterr().err


class FakeCamera:
    """A webcam that gives some frames and is then unplugged."""

    def __init__(self, frames: int, opens: bool = True) -> None:
        self.left, self.opens, self.given, self.released = frames, opens, 0, False
        self.asked: dict[int, float] = {}

    def isOpened(self) -> bool:  # noqa: N802 - as cv2 has it
        return self.opens

    def read(self) -> tuple[bool, Any]:
        if self.given == self.left:
            return False, None
        self.given += 1
        return True, noise(self.given)[..., ::-1]

    def get(self, name: int) -> float:
        return -1.0

    def set(self, name: int, value: float) -> bool:
        self.asked[name] = value
        return True

    def release(self) -> None:
        self.released = True


def test_a_webcam_that_goes_away_keeps_what_it_gave(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = FakeCamera(12)
    words = ("--out", tmp_path, "--write", "video,npz", "--capture-size", "1280x720")
    assert run("/dev/video7", *words, capture=lambda name: camera) == PARTIAL
    assert camera.released and sorted(camera.asked.values()) == [720, 1280]
    said = capsys.readouterr()
    assert "camera /dev/video7: gave no more frames after 12" in said.err
    (video,) = tmp_path.glob("camera_video7_*_depth.mp4")
    arrays = [np.load(path) for path in sorted(tmp_path.glob("*_depth/npz/*"))]
    assert len(frames_of(video)) == len(arrays) >= 1
    dropped = [int(line.split()[0]) for line in said.out.splitlines() if "came while" in line]
    assert len(arrays) + sum(dropped) == 12  # none is lost in silence
    last = frames_of(video)[-1][1][:, :60].astype(int)
    assert np.abs(last - noise(12)[:, :60]).mean() < 12  # the newest was not forgotten


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("0", "plugged in and that no other program reads"),
        ("/dev/video0", "plugged in and that no other program reads"),
        ("rtsp://user:secret@host/live", "an address that answers"),
    ],
)
def test_a_camera_that_is_not_there_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], source: str, expected: str
) -> None:
    assert run(source, "--out", tmp_path, capture=lambda name: FakeCamera(0, False)) == UNUSABLE
    said = capsys.readouterr().err
    assert "cannot be opened" in said and said.count("\n") == 1 and "secret" not in said
    assert expected in said
    assert kept(tmp_path) == []


def test_a_camera_without_a_frame_leaves_no_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("0", "--out", tmp_path, capture=lambda name: FakeCamera(0)) == UNUSABLE
    assert "gave no more frames after 0" in capsys.readouterr().err
    assert kept(tmp_path) == []


@pytest.fixture
def served(tmp_path: Path) -> Callable[[str], str]:
    """A folder that answers at addresses of this machine."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: Any) -> None: ...

    handler = lambda *given: Quiet(*given, directory=str(tmp_path))  # noqa: E731
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    Thread(target=server.serve_forever, daemon=True).start()
    yield lambda name: f"http://127.0.0.1:{server.server_port}/{name}"  # type: ignore[misc]
    server.shutdown()
    server.server_close()


def test_a_video_at_an_address_is_read_whole(tmp_path: Path, served: Callable[[str], str]) -> None:
    make_video(tmp_path / "walk.mp4", [0, 0.1, 0.2, 0.3], picture=noise)
    assert run(served("walk.mp4"), "--out", tmp_path / "out") == ALL
    (video,) = (tmp_path / "out").iterdir()
    assert video.name == "walk_depth.mp4"
    assert [time for time, _ in frames_of(video)] == pytest.approx([0, 0.1, 0.2, 0.3], abs=2e-3)


def stopping_after(frames: int, number: int = signal.SIGINT) -> Callable[[str, str], Any]:
    """A model during whose n-th frame the user presses Ctrl-C."""

    def load(name: str, device: str) -> Any:
        model, seen = load_tiny(), [0]
        encode = model.encode

        def counted(*given: Any, **named: Any) -> Any:
            seen[0] += 1
            if seen[0] == frames:
                os.kill(os.getpid(), number)
            return encode(*given, **named)

        model.encode = counted  # type: ignore[method-assign]
        return model

    return load


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_keeps_what_is_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], number: int
) -> None:
    make_video(tmp_path / "walk.mp4", [index / 10 for index in range(8)])
    before = signal.getsignal(number)
    words = [str(tmp_path / "walk.mp4"), "--write", "video,npz"]
    assert main(words, loader=stopping_after(3, number)) == INTERRUPTED
    assert "stopped before the end; what was done is kept" in capsys.readouterr().err
    assert len(frames_of(tmp_path / "walk_depth.mp4")) == 3
    assert len(kept(tmp_path / "walk_depth")) == 3
    assert (tmp_path / "walk_depth.json").exists()
    assert signal.getsignal(number) == before


def test_ctrl_c_is_how_a_camera_ends(tmp_path: Path) -> None:
    class Endless(FakeCamera):
        def read(self) -> tuple[bool, Any]:
            return True, noise(1)[..., ::-1]

    words = ["0", "--out", str(tmp_path)]
    assert main(words, loader=stopping_after(2), capture=lambda name: Endless(0)) == ALL
    (video,) = tmp_path.iterdir()
    assert len(frames_of(video)) == 2


def test_a_failing_model_leaves_no_half_file(tmp_path: Path) -> None:
    def picture(index: int, size: tuple[int, int]) -> np.ndarray:
        return noise(index) if index < 2 else np.full((*size, 3), FAILING, np.uint8)

    for index in range(3):
        save(tmp_path / "photos" / f"{index}.png", picture(index, SIZE))
    with pytest.raises(RuntimeError, match="must fail"):
        run(tmp_path / "photos", "--write", "video")
    assert kept(tmp_path) == ["photos/0.png", "photos/1.png", "photos/2.png"]


def entities(path: Path) -> set[str]:
    from rerun.chunk import RrdReader

    (recording,) = RrdReader(path).recordings()
    return {str(chunk.entity_path) for chunk in RrdReader(path).stream()} if recording else set()


@pytest.mark.parametrize("metric", ["none", "fixed"])
def test_the_viewer_gets_image_depth_points_and_scale(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, metric: str
) -> None:
    """A file in the place of the viewer's window gets what `--write rrd` writes."""
    rerun = pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    shown = tmp_path / "shown.rrd"

    monkeypatch.setenv("DISPLAY", ":0")

    def into_file(self: Any, *, default_blueprint: Any, **_: Any) -> None:
        self.save(shown, default_blueprint=default_blueprint)

    monkeypatch.setattr(rerun.RecordingStream, "spawn", into_file)
    make_video(tmp_path / "v.mp4", [0, 0.1], (720, 1280), picture=noise)
    words = ("--view", "--write", "rrd", "--metric-source", metric)
    assert run(tmp_path / "v.mp4", *words) == ALL
    scale = "median_depth" if metric == "none" else "median_depth_m"
    expected = {"/camera", "/camera/image", "/camera/depth", "/points", f"/scores/{scale}"}
    assert expected <= entities(shown) and expected <= entities(tmp_path / "v_depth.rrd")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have a display")
def test_a_viewer_without_a_display_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rerun = pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(rerun.RecordingStream, "spawn", lambda self, **_: pytest.fail("opened"))
    make_video(tmp_path / "v.mp4", [0, 0.1])
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        monkeypatch.setattr(view, "_PORT", server.getsockname()[1])
        assert run(tmp_path / "v.mp4", "--view") == UNUSABLE
        assert "needs a display" in capsys.readouterr().err
        assert kept(tmp_path) == ["v.mp4"]
        spawned: list[int] = []  # a viewer that is there already needs no display here
        spawn = lambda self, *, port, **_: spawned.append(port)  # noqa: E731
        monkeypatch.setattr(rerun.RecordingStream, "spawn", spawn)
        monkeypatch.setattr(rerun.RecordingStream, "flush", lambda self, **_: None)
        server.listen()
        assert run(tmp_path / "v.mp4", "--view") == ALL
        assert spawned == [server.getsockname()[1]]


def test_a_viewer_that_is_closed_does_not_end_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rerun = pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    answers = iter([True])

    def flush(self: Any, **_: Any) -> None:
        if not next(answers, False):
            raise RuntimeError("no connection\nand details")

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(rerun.RecordingStream, "spawn", lambda self, **_: None)
    monkeypatch.setattr(rerun.RecordingStream, "flush", flush)
    make_video(tmp_path / "v.mp4", [0, 0.1])
    assert run(tmp_path / "v.mp4", "--view") == ALL
    assert "the Rerun viewer was closed before the end" in capsys.readouterr().err
    assert len(frames_of(tmp_path / "v_depth.mp4")) == 2
    assert run(tmp_path / "v.mp4", "--view", "--overwrite") == UNUSABLE  # it never answers
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.endswith("cannot be opened (no connection); it needs a display")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("nowhere.mp4",), "nowhere.mp4 does not exist; expected a picture, a folder"),
        (("text.mp4",), "text.mp4: expected a video file, no frame can be decoded"),
        (("empty",), "empty: expected pictures"),
        (("walk.mcap",), "walk.mcap is a recording, which dyfn-replay reads"),
        (("ftp://host/x",), "ftp://host/x: expected an address such as rtsp://"),
        (("photo.png", "--rate", "3"), "--rate is for folders and video files"),
        (("photo.png", "--capture-size", "640x480"), "--capture-size is for webcams"),
        (("photo.png", "--camera-matrix", "1", "2"), "expected 4 or 9 numbers, got 2"),
        (("photo.png", "--camera-matrix", "no.txt"), "--camera-matrix no.txt: no.txt"),
    ],
)
def test_a_wrong_source_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    told: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "empty").mkdir()
    (tmp_path / "walk.mcap").write_bytes(b"")
    save(tmp_path / "photo.png", noise(1))
    assert run(*words) == UNUSABLE
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and said[0].startswith("dyfn-depth: ") and told in said[0], said
