"""One sequence reconstructed with and without DyFN, and with true depth as the upper bound."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch

from dyfn_core.data.frames import FrameError, FrameSequence, RgbdFrame
from dyfn_core.evaluation.reconstruction.cloud_error import CloudError, cloud_error
from dyfn_core.evaluation.reconstruction.cloud_pictures import draw_fused
from dyfn_core.evaluation.reconstruction.matching import Matcher, MatchWindow
from dyfn_core.evaluation.reconstruction.poses import Reconstruction, ReconstructionOptions
from dyfn_core.evaluation.reconstruction.trajectory import TrajectoryError, trajectory_error
from dyfn_core.evaluation.report.html import Cell, Table
from dyfn_core.geometry.camera import depth_to_points, pixel_intrinsics
from dyfn_core.geometry.registration import RegistrationError, Similarity
from dyfn_core.geometry.voxel_grid import VoxelGrid
from dyfn_core.models.base import GeometryModel
from dyfn_core.stream.depth_stream import DepthStream

TRUE_DEPTH, WITH_DYFN, BASE = "true depth", "with DyFN", "base model"
TRUE_VOXEL = 0.02  # metres, of the true cloud
SHORT = 0.5  # share of a path's extent that its error may be; of one without scale it is 1
HEADER = (
    "",
    "frames posed",
    "ATE m",
    "RPE m",
    "RPE deg",
    "accuracy m",
    "completeness m",
    "Chamfer m",
    "precision",
    "recall",
)
TABLE_NOTE = (
    "Frames posed: share of the frames whose pose could be found. ATE: camera centres after one "
    "similarity; RPE: motion from frame to frame. Accuracy: mean distance of a reconstructed "
    "point to the true cloud, completeness: the other way round, Chamfer: mean of both. "
    "Precision and recall: shares of points nearer than the tolerance to the other cloud."
)


@dataclass
class SequenceRuns:
    """What came of a sequence.

    runs: by name, one Reconstruction each, all of the same frames. known: true camera-to-world
    poses, None where unknown. true_cloud: true depth fused by the true poses, metres; None
    without either. losses: why frames could not be read -> how many.
    """

    runs: dict[str, Reconstruction]
    known: list[np.ndarray | None] = field(default_factory=list)
    true_cloud: VoxelGrid | None = None
    losses: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True)
class RunResult:
    """One row of the table. trajectory, cloud: None when they could not be had, and `notes` say
    why. problems: why frames have no pose -> how many."""

    frames: int
    posed: int
    trajectory: TrajectoryError | None
    cloud: CloudError | None
    problems: dict[str, int]
    notes: tuple[str, ...]

    def values(self) -> dict[str, Any]:
        """For JSON."""
        path = self.trajectory
        numbers = None
        if path is not None:
            numbers = {
                "ate": path.ate,
                "rpe_metres": _finite(path.rpe_metres),
                "rpe_degrees": _finite(path.rpe_degrees),
                "frames": path.frames,
                "scale": path.alignment.scale,
            }
        return {
            "frames": self.frames,
            "posed": self.posed,
            "trajectory": numbers,
            "cloud": None if self.cloud is None else asdict(self.cloud),
            "problems": self.problems,
            "notes": list(self.notes),
        }


@torch.inference_mode()
def reconstruct_sequence(
    sequence: FrameSequence,
    places: Iterable[int],
    matcher: Matcher,
    model: GeometryModel | None,
    options: ReconstructionOptions | None = None,
    *,
    true_depth: bool = True,
    num_tokens: int | None = None,
    true_poses: bool = False,
) -> SequenceRuns:
    """Reconstruct the frames at `places` of the sequence; the matches are found once for all runs.

    model: None for true depth alone. true_depth: also with the sequence's own depth. true_poses:
    every frame is registered to the true poses of its partners, with predictions brought to metres
    by one scale for the sequence, for which it is run through the model once more. A frame that
    cannot be read is left out and counted. Raises ValueError when there is nothing to run, or no
    frame could be read.
    """
    chosen = options or ReconstructionOptions()
    streams = {} if model is None else model_streams(model, num_tokens)
    names = [*([TRUE_DEPTH] if true_depth else []), *streams]
    if not names:
        raise ValueError("nothing to reconstruct from: give a model, or use the true depth")
    found = SequenceRuns({name: Reconstruction(chosen) for name in names})
    window, places = MatchWindow(matcher, max(chosen.offsets)), list(places)
    metres = dict.fromkeys(streams, 1.0)
    if true_poses and model is not None:
        metres = sequence_scales(sequence, places, model_streams(model, num_tokens))
    for frame in _readable(sequence, places, found.losses):
        window.push(frame.image)
        true_points, true_valid = _true_points(frame)
        known = _known_pose(frame, sequence.name) if true_poses else None
        for name, run in found.runs.items():
            if name == TRUE_DEPTH:
                run.push(frame.image, true_points, true_valid, window, known)
            else:
                points, valid = _predicted(streams[name], frame)
                run.push(frame.image, points * metres[name], valid, window, known)
        found.known.append(frame.pose)
        _fuse_truth(found, frame, true_points, true_valid, chosen)
    if not found.known:
        raise ValueError(f"{sequence.name}: no frame could be read: {dict(found.losses)}")
    return found


def model_streams(model: GeometryModel, num_tokens: int | None) -> dict[str, DepthStream]:
    """The runs that a model gives: with its stabilizer, if it has one, and without."""
    ways = {WITH_DYFN: True, BASE: False} if model.stabilizer is not None else {BASE: False}
    return {
        name: DepthStream(model, stabilize=stabilize, num_tokens=num_tokens)
        for name, stabilize in ways.items()
    }


def sequence_scales(
    sequence: FrameSequence, places: Iterable[int], streams: Mapping[str, DepthStream]
) -> dict[str, float]:
    """Metres in one predicted unit: the median over frames of the median of true over predicted.

    Raises ValueError when no frame has true depth.
    """
    ratios: dict[str, list[float]] = {name: [] for name in streams}
    for frame in _readable(sequence, places, Counter()):
        truth, known = _true_points(frame)
        for name, stream in streams.items():
            points, valid = _predicted(stream, frame)
            both = known & valid & (points[..., 2] > 0)
            if both.any():
                ratios[name].append(float(np.median(truth[both][:, 2] / points[both][:, 2])))
    empty = [name for name, found in ratios.items() if not found]
    if empty:
        raise ValueError(f"{sequence.name}: no true depth to scale {empty[0]!r} by")
    return {name: float(np.median(found)) for name, found in ratios.items()}


def _known_pose(frame: RgbdFrame, name: str) -> Similarity:
    if frame.pose is None or not np.isfinite(frame.pose).all():
        raise ValueError(f"{name}: a frame has no true pose to register others to")
    return Similarity.from_matrix(frame.pose)


def _readable(
    sequence: FrameSequence, places: Iterable[int], losses: Counter[str]
) -> Iterator[RgbdFrame]:
    for place in places:
        try:
            yield sequence.read(place)
        except FrameError as error:
            losses[str(error)] += 1


def camera_matrix(frame: RgbdFrame) -> np.ndarray:
    """3 x 3 intrinsics of a frame, normalised."""
    fx, fy, cx, cy = (float(value) for value in frame.intrinsics)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _true_points(frame: RgbdFrame) -> tuple[np.ndarray, np.ndarray]:
    """H x W x 3 float32 metres, and H x W bool."""
    valid = np.isfinite(frame.depth) & (frame.depth > 0)
    depth = torch.from_numpy(np.where(valid, frame.depth, 0).astype(np.float32))
    return depth_to_points(depth[None], torch.from_numpy(camera_matrix(frame))[None])[
        0
    ].numpy(), valid


def _predicted(stream: DepthStream, frame: RgbdFrame) -> tuple[np.ndarray, np.ndarray]:
    stream.camera_matrix = pixel_intrinsics(camera_matrix(frame), frame.image.shape[:2])
    prediction = stream.push(frame.image)
    return prediction.points.float().cpu().numpy(), prediction.mask.cpu().numpy()


def _fuse_truth(
    found: SequenceRuns,
    frame: RgbdFrame,
    points: np.ndarray,
    valid: np.ndarray,
    options: ReconstructionOptions,
) -> None:
    if frame.pose is None or not np.isfinite(frame.pose).all() or not valid.any():
        return
    if found.true_cloud is None:
        found.true_cloud = VoxelGrid(TRUE_VOXEL, options.max_voxels)
    step = options.stride
    kept = valid[::step, ::step]
    world = Similarity.from_matrix(frame.pose).apply(points[::step, ::step][kept])
    found.true_cloud.add(world, frame.image[::step, ::step][kept])


def judge(found: SequenceRuns, name: str, tolerance: float = 0.05) -> RunResult:
    """Errors of one run against what is known. tolerance: metres, for precision and recall."""
    run = found.runs[name]
    notes = []
    trajectory, cloud = None, None
    try:
        trajectory = trajectory_error(run.poses, found.known)
    except RegistrationError as error:
        notes.append(f"no pose error: {error}")
    if trajectory is not None and trajectory.ate > SHORT * trajectory.extent:
        notes.append(
            f"the path's error, {trajectory.ate:.3f} m, is near its extent, "
            f"{trajectory.extent:.3f} m: it fixes no scale, and the cloud's error says nothing; "
            "take more frames, or frames farther apart"
        )
    if trajectory is not None and found.true_cloud is None:
        notes.append("no cloud error: no true depth")
    points, _, metric = aligned_cloud(found, name)
    if metric and found.true_cloud is not None and len(points):
        cloud = cloud_error(points, found.true_cloud.cloud()[0], tolerance)
    posed = sum(pose is not None for pose in run.poses)
    return RunResult(len(run.frames), posed, trajectory, cloud, run.problems(), tuple(notes))


def aligned_cloud(found: SequenceRuns, name: str) -> tuple[np.ndarray, np.ndarray, bool]:
    """Points N x 3, colours N x 3 uint8, and whether they are in the true world in metres."""
    run = found.runs[name]
    if run.cloud is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8), False
    points, colours = run.cloud.cloud()
    fit = _alignment(found, name)
    return (points, colours, False) if fit is None else (fit.apply(points), colours, True)


def _alignment(found: SequenceRuns, name: str) -> Similarity | None:
    try:
        return trajectory_error(found.runs[name].poses, found.known).alignment
    except RegistrationError:
        return None


def draw_run(found: SequenceRuns, name: str) -> np.ndarray:
    """The run's cloud from above and obliquely, side by side, H x W x 3 uint8 RGB."""
    points, colours, _ = aligned_cloud(found, name)
    fit = _alignment(found, name) or Similarity.identity()
    poses = [None if pose is None else fit.after(pose) for pose in found.runs[name].poses]
    views = [draw_fused(points, colours, poses, oblique=oblique) for oblique in (False, True)]
    return np.hstack(views)


def reconstruction_table(results: Mapping[str, RunResult]) -> Table:
    """All runs in one table."""
    return Table(HEADER, [[name, *_cells(result)] for name, result in results.items()])


def _cells(result: RunResult) -> Sequence[Cell]:
    path, cloud = result.trajectory, result.cloud
    poses = (None,) * 3 if path is None else (path.ate, path.rpe_metres, path.rpe_degrees)
    clouds: tuple[Cell, ...] = (None,) * 5
    if cloud is not None:
        clouds = (
            cloud.accuracy,
            cloud.completeness_distance,
            cloud.chamfer,
            cloud.precision,
            cloud.completeness,
        )
    return [f"{result.posed} of {result.frames}", *poses, *clouds]


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
