"""dyfn-app: a video is dropped in a real browser, and its depth, scale and cloud are seen."""

from __future__ import annotations

import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest

from tests.support.browser import NAMES
from tests.support.made_videos import make_video, panning
from tests.support.tiny_model import load_tiny

gradio = pytest.importorskip("gradio", reason="the extra `app` is not installed")
from dyfn_ros.app.cli import UNUSABLE, build, estimator, main, serve  # noqa: E402
from dyfn_ros.app.estimate import BASE, DYFN, Wanted, Watched, estimate, scale_curves  # noqa: E402
from dyfn_ros.app.options import parser  # noqa: E402

WEBGL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]


def tiny(name: str, device: str) -> Any:
    return load_tiny()


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    return make_video(tmp_path / "walk.mp4", [0, 0.1, 0.2, 0.3], picture=panning)


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port: int = found.getsockname()[1]
        return port


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    given = parser().parse_args(["--port", str(free_port())])
    blocks = build(given, tmp_path, tiny)
    yield serve(blocks, given, block=False)
    blocks.close()


def test_a_video_is_dropped_and_its_depth_is_seen(address: str, walk: Path) -> None:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    browser = next(filter(None, map(shutil.which, NAMES)), None)
    if browser is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)}")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=browser, args=WEBGL)
        shown = opened.new_page()
        asked: list[str] = []
        shown.on("request", lambda request: asked.append(request.url))
        shown.goto(address)
        shown.set_default_timeout(60_000)
        shown.locator("input[type=file]").first.set_input_files(walk)
        shown.locator("video").first.wait_for(state="attached")
        shown.get_by_role("button", name="Estimate depth").click()
        frame = shown.frame_locator("iframe[title='scale and cloud']")
        frame.locator("canvas").wait_for()
        assert "over that of the video" in frame.locator("body").inner_text()
        assert frame.locator("svg path, svg polyline").count() >= 2  # DyFN and base
        assert shown.locator("video[src*=walk_depth]").count() == 1
        opened.close()
    away = [url for url in asked if not url.startswith((address, "data:", "blob:", "about:"))]
    assert away == []


def test_wrong_input_is_said(tmp_path: Path) -> None:
    click = estimator(parser().parse_args([]), tmp_path, tiny)
    with pytest.raises(gradio.Error, match="no video yet"):
        click(None, 10, 1, None, True)
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    with pytest.raises(gradio.Error, match=r"broken\.mp4"):
        click(str(tmp_path / "broken.mp4"), 10, 1, None, True)


def test_frames_and_stride_are_those_asked_for(walk: Path, tmp_path: Path) -> None:
    wanted = Wanted(walk, frames=2, stride=2, compare=False)
    video, page = estimate(wanted, tmp_path / "out", tiny, "tiny", "cpu", 1)
    captured = cv2.VideoCapture(str(video))
    assert captured.get(cv2.CAP_PROP_FRAME_COUNT) == 2
    assert "2 frames" in page and f">{BASE}<" not in page and f">{DYFN}<" in page


def test_the_curve_is_the_medians_over_their_median() -> None:
    run = Watched(seconds=[0, 1, 2], medians=[1.0, 2.0, 4.0])
    assert scale_curves({DYFN: run}).lines[DYFN].tolist() == [0.5, 1, 2]


def test_a_port_in_use_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main(["--port", str(taken.getsockname()[1])], tiny) == UNUSABLE
    assert "dyfn-app: " in capsys.readouterr().err
