"""What to read, what to run and what to write: one value for each, handed to its owner alone.

Nothing slow is imported here, so that `dyfn-replay --help` answers at once.
"""

from __future__ import annotations

import importlib.util
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from dyfn_core.metric.odometry_noise import OdometryNoise
from dyfn_core.quantities import DEPTH
from dyfn_core.stream.options import StreamOptions
from dyfn_core.threads import THREADS
from dyfn_ros.messages.odometry_options import OdometryOptions
from dyfn_ros.messages.reference_options import ReferenceOptions

MCAP, RAW, PLY, VIDEO, RRD = "mcap", "raw", "ply", "video", "rrd"
FILES = {
    MCAP: "output.mcap",
    RAW: "output.mcap",  # with depth and clouds as they were predicted
    PLY: "cloud.ply",
    VIDEO: "video.mp4",
    RRD: "output.rrd",
}
LAYOUT = "output.foxglove.json"  # beside output.mcap
# The video is a default only where the extra `video` is installed.
DEFAULT = (MCAP, PLY, VIDEO) if importlib.util.find_spec("av") else (MCAP, PLY)
NONE = "none"
VOXEL = 0.02  # metres


@dataclass(frozen=True)
class Source:
    """What `reader.SourceReader` reads.

    Attributes:
        recording: rosbag2 folder, bag file or RGB-D folder.
        image_topic: Colour image topic; None: found by type.
        camera_info_topic: Its CameraInfo; None: found by type, "none": unknown intrinsics.
        depth_topic: Ground truth; None: found by type, "none": no scores.
        depth_info_topic: CameraInfo of a depth camera that is not the image's.
        depth_scale: Stored depth values per metre; None: as the encoding or the layout says.
        depth_offset: Seconds that the depth's stamps are after those of the images.
        depth_transform: Its pose in the image's optical frame, 'x y z qx qy qz qw', metres.
        image_bits: That the values of 16-bit images have.
        reference_topic: Measurements for metric_source "reference"; None: found by type.
        odometry_topic: Poses for metric_source "odometry", see recordings.poses.PoseTopic.
        odometry_offset: Seconds that their stamps are after those of the images.
        odometry_noise: Errors that are added to them; None: none.
        stamps: Times of the headers, or of the log.
        tolerance: Seconds between the stamps of an image and its ground truth.
        stride: Every N-th frame is read.
        max_frames: At most this many frames are read; None: all.
    """

    recording: Path
    image_topic: str | None = None
    camera_info_topic: str | None = None
    depth_topic: str | None = None
    depth_info_topic: str | None = None
    depth_transform: str | None = None
    depth_scale: float | None = None
    depth_offset: float = 0.0
    image_bits: int = 16
    reference_topic: str | None = None
    odometry_topic: str | None = None
    odometry_offset: float = 0.0
    odometry_noise: OdometryNoise | None = None
    stamps: Literal["header", "log"] = "header"
    tolerance: float = 0.02
    stride: int = 1
    max_frames: int | None = None


@dataclass(frozen=True)
class SessionOptions(OdometryOptions, ReferenceOptions, StreamOptions):
    """The node's options of a stream, its reference and its odometry, with the node's defaults."""


@dataclass(frozen=True)
class Run:
    """What `runner` runs over the frames.

    Attributes:
        model: Bundled name, checkpoint file or Hub id.
        device: "auto" (a GPU if there is one), "cpu", "cuda" or "cuda:N".
        backend: Library that runs the network, see models.load_model.
        threads: CPU threads of inference; 0: torch's own choice.
        stream: The stream session's options.
        load_state: Go on from stream.state_file.
        save_state: Leave the state after the last frame in stream.state_file.
        compare: Also run the base model, for one report on both.
        controls: Also run DyFN's controls (models.controls.latent_controls).
    """

    model: str = "dyfn-mini"
    device: str = "auto"
    backend: str = "torch"
    threads: int = THREADS
    stream: SessionOptions = SessionOptions()
    load_state: bool = False
    save_state: bool = False
    compare: bool = False
    controls: bool = False

    def without_dyfn(self) -> Run:
        """The same run of the base model; a saved state is DyFN's and stays out of it.

        Odometry steadies the depth too, so the base goes without it.
        """
        return self._variant(stabilize=False)._without_odometry()

    def without_odometry(self) -> Run | None:
        """The same run in the model's own unit, without a saved state; None when it is that."""
        if self.stream.metric_source != "odometry":
            return None
        return self._variant(self.stream.stabilize)._without_odometry()

    def with_dyfn(self) -> Run:
        """The same run with DyFN, or what stands in its place, and without a saved state.

        Without odometry, which would steady what stands there.
        """
        return self._variant(stabilize=True)._without_odometry()

    def _without_odometry(self) -> Run:
        if self.stream.metric_source != "odometry":
            return self
        return replace(self, stream=replace(self.stream, metric_source="none"))

    def _variant(self, stabilize: bool) -> Run:
        stream = replace(self.stream, stabilize=stabilize)
        return replace(self, stream=stream, load_state=False, save_state=False)


@dataclass(frozen=True)
class PredictionTopic:
    """A recorded topic that `score_topic` scores; no model runs.

    Attributes:
        topic: Images of predictions, whoever made them.
        quantity: What they hold, one of quantities.QUANTITIES.
    """

    topic: str
    quantity: str = DEPTH


@dataclass(frozen=True)
class Outputs:
    """What is scored and written, and where: for `outputs` and `results`.

    Attributes:
        folder: Takes every file.
        write: Names of FILES, beside scores and report.
        pose_topic: Poses for cloud.ply, see recordings.poses.open_poses.
        pose_offset: Seconds that their stamps are after those of the images.
        voxel: Edge of a voxel of cloud.ply, metres.
        depth_max: Ground truth and points of cloud.ply beyond it (metres) are left out.
        progress: Whether a progress bar is drawn on stderr.
    """

    folder: Path
    write: tuple[str, ...] = DEFAULT
    pose_topic: str | None = None
    pose_offset: float = 0.0
    voxel: float = VOXEL
    depth_max: float = math.inf
    progress: bool = True


@dataclass(frozen=True)
class ReplayJob:
    """One image topic of one recording: what to read, what to run or score, what to write.

    Attributes:
        source: Frames and their truth.
        run: What is run over them, or scored instead.
        outputs: What is scored and written.
        strict: Whether an implausible result counts as partial.
    """

    source: Source
    run: Run | PredictionTopic
    outputs: Outputs
    strict: bool = False


@dataclass(frozen=True)
class TopicChoice:
    """Which image topics are replayed, each as a job of its own.

    Attributes:
        names: Topics; empty: the one of the Source.
        every: Every colour image topic of the recording, instead of `names`.
    """

    names: tuple[str, ...] = ()
    every: bool = False


@dataclass(frozen=True)
class BatchOptions:
    """How several recordings are replayed.

    Attributes:
        jobs: Worker processes on this machine.
        ray: Address of a Ray cluster, "local" for one made here; None: no Ray.
    """

    jobs: int = 1
    ray: str | None = None


def parse_outputs(text: str) -> tuple[str, ...]:
    """Read a list of outputs.

    Args:
        text: Names of FILES with commas between them, or "none".

    Returns:
        The names, each once, in the order of FILES.

    Raises:
        ValueError: A name is unknown; the text lists the known ones.
    """
    names = {name.strip() for name in text.split(",")} - {NONE}
    unknown = sorted(names - FILES.keys())
    if unknown:
        raise ValueError(f"unknown output {unknown[0]!r}, expected some of {', '.join(FILES)}")
    return tuple(name for name in FILES if name in names)
