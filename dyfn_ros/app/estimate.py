"""A video through `dyfn-depth`, and the page of its scale and its clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dyfn_core.evaluation.report.cloud_view import CloudView, PointCloud
from dyfn_core.evaluation.report.curves import Curves
from dyfn_core.evaluation.report.html import Section, Text, report_html
from dyfn_core.prediction import Prediction
from dyfn_core.stream.options import StreamOptions
from dyfn_ros.depth.outputs import solid
from dyfn_ros.depth.run import ModelLoader, Outcome, Stop, run
from dyfn_ros.depth.settings import VIDEO, Camera, DepthJob, Reading, Writing
from dyfn_ros.depth.source import SourceFrame
from dyfn_ros.depth.view import median_depth

CLOUDS = 3  # evenly over the video
DYFN, BASE = "DyFN", "base"


@dataclass(frozen=True)
class Wanted:
    """What is done with a video.

    Attributes:
        video: The file.
        frames: Most frames that are worked on, from the start.
        stride: Every N-th frame is used.
        fov: Horizontal field of view in degrees; None: the model estimates the camera.
        compare: Whether the model runs without DyFN as well.
    """

    video: Path
    frames: int
    stride: int = 1
    fov: float | None = None
    compare: bool = True


@dataclass
class Watched:
    """What a run showed.

    Attributes:
        seconds: Of each frame, from the video's start.
        medians: Median depth of each frame; NaN: no depth.
        shown: Evenly spaced frames, at most 2 * CLOUDS of them, with their depth.
    """

    seconds: list[float] = field(default_factory=list)
    medians: list[float] = field(default_factory=list)
    shown: list[tuple[SourceFrame, Prediction[np.ndarray]]] = field(default_factory=list)
    _every: int = 1

    def __call__(self, frame: SourceFrame, prediction: Prediction[np.ndarray]) -> None:
        """Take one frame."""
        if len(self.medians) % self._every == 0:
            self.shown.append((frame, prediction))
        if len(self.shown) > 2 * CLOUDS:
            self.shown, self._every = self.shown[::2], 2 * self._every
        self.seconds.append(frame.stamp)
        self.medians.append(median_depth(prediction))


def estimate(
    wanted: Wanted, out: Path, loader: ModelLoader, model: str, device: str, threads: int
) -> tuple[Path, str]:
    """Run a video.

    Args:
        wanted: What to do.
        out: Folder for the depth video.
        loader: Gives the model.
        model: Its name.
        device: Where it runs.
        threads: CPU threads of it.

    Returns:
        The video of input and depth, and a page of HTML with the scale over time and clouds.

    Raises:
        RecordingError: The video cannot be used.
        ValueError: An option is wrong.
    """
    runs: dict[str, Watched] = {}
    outcomes: list[Outcome] = []
    for name in (DYFN, BASE) if wanted.compare else (DYFN,):
        runs[name] = Watched()
        job = DepthJob(
            Reading(str(wanted.video), stride=wanted.stride, max_frames=wanted.frames),
            Camera(fov=wanted.fov),
            Writing(write=(VIDEO,) if name == DYFN else (), out=out, overwrite=True),
            StreamOptions(stabilize=name == DYFN),
            model,
            device,
            threads,
        )
        outcomes.append(run(job, loader, Stop(), watch=runs[name]))
    (video,) = outcomes[0].written
    return Path(video), page(runs, outcomes[0])


def page(runs: dict[str, Watched], outcome: Outcome) -> str:
    """HTML of what the runs showed.

    Args:
        runs: Name -> what it showed; all of the same frames.
        outcome: Of the first.
    """
    said = [f"{outcome.frames} frames", *outcome.notes]
    said += [f"loss: {text}" for text in outcome.losses]
    said += [f"warning: {text}" for text in outcome.warnings]
    first = next(iter(runs.values()))
    sections = [Section("Scale over time", [scale_curves(runs), Text("; ".join(said), note=True)])]
    clouds = clouds_of(first.shown)
    if clouds:
        view = CloudView(clouds, unit="", alt="points of single frames")
        sections.append(Section("Cloud", [view]))
    return report_html("Depth of a video", sections)


def scale_curves(runs: dict[str, Watched]) -> Curves:
    """Median depth of each frame over that of the whole run."""
    lines = {name: np.array(run.medians) / np.nanmedian(run.medians) for name, run in runs.items()}
    return Curves(
        "median depth of each frame over that of the video",
        lines,
        x_label="seconds",
        y_label="ratio",
        x=next(iter(runs.values())).seconds,
    )


def clouds_of(
    shown: Sequence[tuple[SourceFrame, Prediction[np.ndarray]]],
) -> dict[str, PointCloud]:
    """Clouds of the first, the middle and the last of the frames, without flying pixels."""
    found: dict[str, PointCloud] = {}
    for place in sorted({0, len(shown) // 2, len(shown) - 1} & set(range(len(shown)))):
        frame, prediction = shown[place]
        used = solid(prediction)
        if used.any():
            found[f"{frame.stamp:.1f} s"] = PointCloud(prediction.points[used], frame.image[used])
    return found
