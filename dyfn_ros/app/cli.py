"""`dyfn-app`: the page, served."""

from __future__ import annotations

import html
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dyfn_ros.app.options import parser

if TYPE_CHECKING:
    import argparse

    from dyfn_ros.depth.run import ModelLoader

# Nothing is fetched from or told to anybody: no analytics, fonts of the reader's machine.
os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")
FONT = ["system-ui", "sans-serif"]
MONO = ["ui-monospace", "monospace"]
TITLE = "Depth that keeps its scale"
ALL, UNUSABLE = 0, 2  # exit codes


def main(arguments: Sequence[str] | None = None, loader: ModelLoader | None = None) -> int:
    """Serve the page until Ctrl-C.

    Args:
        arguments: Without the program's name; None: those of the process.
        loader: Gives the model; None: load_model.

    Returns:
        The exit code.
    """
    given = parser().parse_args(arguments)  # ends the process for --help and wrong options
    with tempfile.TemporaryDirectory(prefix="dyfn-app-") as folder:
        try:
            serve(build(given, Path(folder), loader), given)
        except (OSError, ValueError) as error:
            print(f"dyfn-app: {error}", file=sys.stderr)
            return UNUSABLE
    return ALL


def serve(blocks: Any, given: argparse.Namespace, block: bool = True) -> str:
    """Serve the page.

    Args:
        blocks: It.
        given: The command line.
        block: Whether to return only after Ctrl-C.

    Returns:
        Its address.
    """
    import gradio

    _, address, _ = blocks.queue(default_concurrency_limit=1).launch(
        server_name=given.host,
        server_port=given.port,
        theme=gradio.themes.Default(font=FONT, font_mono=MONO),
        footer_links=[],
        prevent_thread_lock=not block,
        quiet=not block,
    )
    return str(address)


def build(given: argparse.Namespace, folder: Path, loader: ModelLoader | None = None) -> Any:
    """The page.

    Args:
        given: The command line.
        folder: For results.
        loader: Gives the model; None: load_model.

    Returns:
        Gradio's Blocks.
    """
    import gradio

    estimate = estimator(given, folder, loader)
    with gradio.Blocks(title=TITLE) as blocks:
        gradio.Markdown(f"# {TITLE}\nDrop a video of a moving camera.")
        with gradio.Row():
            with gradio.Column():
                video = gradio.Video(label="video", sources=["upload", "webcam"])
                frames = gradio.Slider(
                    1, given.most_frames, min(150, given.most_frames), step=1, label="frames"
                )
                stride = gradio.Slider(1, 30, 1, step=1, label="every N-th frame")
                fov = gradio.Number(
                    None, label="horizontal field of view, degrees (empty: estimated)"
                )
                compare = gradio.Checkbox(True, label="run the model without DyFN as well")
                go = gradio.Button("Estimate depth", variant="primary")
            depth = gradio.Video(label="depth: red near, blue far", interactive=False)
        page = gradio.HTML()
        go.click(estimate, [video, frames, stride, fov, compare], [depth, page], api_name="depth")
    return blocks


def estimator(
    given: argparse.Namespace, folder: Path, loader: ModelLoader | None
) -> Callable[..., tuple[str, str]]:
    """What the button does."""
    import gradio

    from dyfn_ros.app.estimate import Wanted, estimate
    from dyfn_ros.recordings.errors import RecordingError
    from dyfn_ros.replay.run import load

    loaded = cache(loader or load)

    def click(
        video: str | None, frames: float, stride: float, fov: float | None, compare: bool
    ) -> tuple[str, str]:
        if video is None:
            raise gradio.Error("no video yet: drop one, or record one")
        wanted = Wanted(Path(video), int(frames), int(stride), fov or None, compare)
        out = Path(tempfile.mkdtemp(dir=folder))
        try:
            made, page = estimate(wanted, out, loaded, given.model, given.device, given.threads)
        except (RecordingError, ValueError, OSError) as error:
            raise gradio.Error(str(error)) from error
        return str(made), framed(page)

    return click


def framed(page: str) -> str:
    """A page inside a page, with its scripts."""
    source = html.escape(page, quote=True)
    return (
        f'<iframe title="scale and cloud" srcdoc="{source}" '
        'style="width: 100%; height: 1100px; border: 0"></iframe>'
    )


if __name__ == "__main__":
    sys.exit(main())
