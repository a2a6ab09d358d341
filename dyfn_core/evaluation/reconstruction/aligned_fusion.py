"""Depth aligned to the truth and fused with the true poses: what its alignment costs (figure 2)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyfn_core.data.frames import FrameError, FrameSequence, RgbdFrame
from dyfn_core.evaluation.benchmarks.model_method import as_array
from dyfn_core.evaluation.reconstruction.cloud_error import CloudError, cloud_error
from dyfn_core.evaluation.reconstruction.poses import EDGE_SHARE
from dyfn_core.evaluation.reconstruction.runs import TRUE_VOXEL, camera_matrix, model_streams
from dyfn_core.evaluation.report.html import Cell, Table
from dyfn_core.geometry.camera import depth_to_points, pixel_intrinsics
from dyfn_core.geometry.edges import flying_pixels
from dyfn_core.geometry.registration import Similarity
from dyfn_core.geometry.voxel_grid import VoxelGrid
from dyfn_core.models.base import GeometryModel
from dyfn_core.quantities import scored_quantity
from dyfn_core.scoring.protocols import FARTHEST, MIN_DEPTH, SequenceScorer, align_depth
from dyfn_core.stream.depth_stream import DepthStream

TRUTH = "true depth"
PER_FRAME, PER_SEQUENCE = "per frame", "per sequence"
ALIGNMENTS = (PER_FRAME, PER_SEQUENCE)
NO_POSE = "frame without a true pose"
HEADER = (
    *("", "aligned", "AbsRel", "delta1", "accuracy m", "completeness m", "Chamfer m"),
    *("precision", "recall"),
)
TABLE_NOTE = (
    "Depth is aligned to the truth by scale and shift and fused with the true poses: per frame "
    "(each frame its own scale and shift) or per sequence (one for all frames). AbsRel and delta1: "
    "of the depth under that alignment. The other columns compare the clouds."
)


@dataclass
class AlignedCloud:
    """One variant under one alignment: metrics of its depth, and the fused points in metres."""

    metrics: dict[str, float]
    cloud: VoxelGrid


@dataclass
class AlignedFusion:
    """What came of a sequence.

    clouds: (variant, alignment) -> its scores and cloud. truth: true depth fused by true poses.
    poses: the frames' true poses, camera to world. losses: why frames were left out -> how many.
    """

    clouds: dict[tuple[str, str], AlignedCloud]
    truth: VoxelGrid
    poses: list[Similarity]
    losses: Counter[str]

    def error(self, key: tuple[str, str], tolerance: float) -> CloudError:
        """Distances of a cloud to the true one, metres."""
        return cloud_error(self.clouds[key].cloud.cloud()[0], self.truth.cloud()[0], tolerance)

    def values(self, tolerance: float) -> dict[str, dict[str, Any]]:
        """Variant -> alignment -> scores, for JSON."""
        found: dict[str, dict[str, Any]] = {}
        for (variant, alignment), one in self.clouds.items():
            cloud = asdict(self.error((variant, alignment), tolerance))
            found.setdefault(variant, {})[alignment] = {"depth": one.metrics, "cloud": cloud}
        return found


@dataclass
class _Run:
    """Depth of one variant as it comes: its scorer, and every stride-th pixel of each frame."""

    quantity: str
    scorer: SequenceScorer = field(init=False)
    depth: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.scorer = SequenceScorer(quantity=self.quantity)

    def fits(self, alignment: str) -> tuple[list[tuple[float, float] | None], dict[str, float]]:
        """Scale and shift of every frame, None where it cannot be fitted, and the metrics."""
        score = self.scorer.image() if alignment == PER_FRAME else self.scorer.video()
        if score is None:
            raise ValueError("no frame has enough true depth to align a prediction to")
        if alignment == PER_SEQUENCE:
            return [(score.scale, score.shift)] * len(self.depth), score.metrics
        fits = [
            None if frame.scale is None or frame.shift is None else (frame.scale, frame.shift)
            for frame in self.scorer.frames
        ]
        return fits, score.metrics


@dataclass(frozen=True)
class _View:
    """What points are made with: every stride-th ray H x W x 3 (z = 1), colour, and the pose."""

    rays: np.ndarray
    colours: np.ndarray
    pose: Similarity


@torch.inference_mode()
def fuse_aligned(
    sequence: FrameSequence,
    places: Iterable[int],
    model: GeometryModel,
    *,
    num_tokens: int | None = None,
    stride: int = 2,
    max_voxels: int = 500_000,
) -> AlignedFusion:
    """Fuse predicted depth with the true poses and cameras, under both alignments.

    Args:
        sequence: Frames with true depth and poses.
        places: Which of them.
        model: With its stabilizer, if it has one, and without.
        num_tokens: Resolution inside the model; None: its own.
        stride: Every how many-th pixel is fused; these are kept until the sequence has ended.
        max_voxels: Voxels of 2 cm double in size when a cloud has more.

    Raises:
        ValueError: No frame has a pose, or none has enough true depth.
    """
    streams, quantity = model_streams(model, num_tokens), scored_quantity(model.quantity)
    runs = {name: _Run(quantity) for name in streams}
    truth, views, losses = VoxelGrid(TRUE_VOXEL, max_voxels), list[_View](), Counter[str]()
    for frame in _posed(sequence, places, losses):
        view = _view(frame, stride)
        views.append(view)
        for name, run in runs.items():
            depth = _predicted(streams[name], frame)
            run.scorer.push(depth, frame.depth)
            run.depth.append(depth[::stride, ::stride])
        _add(truth, view, frame.depth[::stride, ::stride])
    if not views:
        raise ValueError(f"{sequence.name}: no frame with a true pose: {dict(losses)}")
    clouds = {
        (name, alignment): _fused(run, alignment, views, max_voxels)
        for name, run in runs.items()
        for alignment in ALIGNMENTS
    }
    return AlignedFusion(clouds, truth, [view.pose for view in views], losses)


def _posed(
    sequence: FrameSequence, places: Iterable[int], losses: Counter[str]
) -> Iterator[RgbdFrame]:
    for place in places:
        try:
            frame = sequence.read(place)
        except FrameError as error:
            losses[str(error)] += 1
            continue
        if frame.pose is None or not np.isfinite(frame.pose).all():
            losses[NO_POSE] += 1
            continue
        yield frame


def _view(frame: RgbdFrame, stride: int) -> _View:
    assert frame.pose is not None, "frames without one were left out"
    matrix: Tensor = torch.from_numpy(camera_matrix(frame))[None]
    rays = depth_to_points(torch.ones(1, *frame.depth.shape), matrix)[0].numpy()
    kept = rays[::stride, ::stride], frame.image[::stride, ::stride].copy()
    return _View(*kept, Similarity.from_matrix(frame.pose))


def _predicted(stream: DepthStream, frame: RgbdFrame) -> np.ndarray:
    """What is aligned, H x W float32; NaN where it is masked or hangs between two surfaces."""
    stream.camera_matrix = pixel_intrinsics(camera_matrix(frame), frame.image.shape[:2])
    prediction = stream.push(frame.image)
    depth = prediction.depth.float().cpu().numpy()
    usable = prediction.mask.cpu().numpy() & np.isfinite(depth)
    hanging = flying_pixels(depth, usable, EDGE_SHARE)
    return np.where(hanging, np.float32(np.nan), as_array(prediction))


def _fused(run: _Run, alignment: str, views: list[_View], max_voxels: int) -> AlignedCloud:
    fits, metrics = run.fits(alignment)
    cloud = VoxelGrid(TRUE_VOXEL, max_voxels)
    for view, values, fit in zip(views, run.depth, fits, strict=True):
        if fit is not None:
            _add(cloud, view, align_depth(values, *fit, run.quantity))
    return AlignedCloud(metrics, cloud)


def _add(cloud: VoxelGrid, view: _View, depth: np.ndarray) -> None:
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(depth) & (depth > MIN_DEPTH) & (depth < FARTHEST)
    points = view.rays[valid] * depth[valid, None]
    cloud.add(view.pose.apply(points), view.colours[valid])


def fusion_table(values: Mapping[str, Mapping[str, Any]]) -> Table:
    """A row per variant and alignment, of what AlignedFusion.values gave."""
    columns = ("accuracy", "completeness_distance", "chamfer", "precision", "completeness")
    rows: list[list[Cell]] = []
    for variant, alignments in values.items():
        for alignment, found in alignments.items():
            depth = [found["depth"][metric] for metric in ("abs_rel", "delta1")]
            rows.append([variant, alignment, *depth, *(found["cloud"][c] for c in columns)])
    return Table(HEADER, rows)
