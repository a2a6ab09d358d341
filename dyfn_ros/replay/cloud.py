"""The clouds of a replay: the PLY of every frame's points in the world, and the report's view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dyfn_core.evaluation.reconstruction.cloud_error import write_ply
from dyfn_core.evaluation.report.cloud_view import CloudView, PointCloud
from dyfn_core.files import finished_file
from dyfn_core.geometry.registration import Similarity
from dyfn_core.geometry.voxel_grid import VoxelGrid
from dyfn_ros.replay.frame_spool import FrameSpool, SmallFrame
from dyfn_ros.replay.shown_run import Alignment, ShownRun

VIEW_VOXELS = 200_000  # of a cloud that only the report shows
TRUTH = "ground truth"

# Gives the depth (h x w) of a frame and where it is to be used; None: it has none.
DepthOf = Callable[[SmallFrame], "tuple[np.ndarray, np.ndarray] | None"]


@dataclass(frozen=True)
class FusedCloud:
    """points: N x 3 float32 in the poses' world; colours: N x 3 uint8. poses: of its frames."""

    points: np.ndarray
    colours: np.ndarray
    poses: list[Similarity]


def write_cloud(
    path: Path, spool: FrameSpool, alignment: Alignment, voxel: float, depth_max: float
) -> tuple[FusedCloud | None, str]:
    """Fuse the frames that have a pose into a coloured binary PLY, in metres of the poses' world.

    voxel: edge of a voxel in metres; it doubles while the cloud would be too large.
    depth_max: metres, farther points are left out. Flying pixels at depth edges are left out.
    Returns the cloud (None without a point), and what to warn about, "" for nothing. Raises
    OutputError.
    """
    grid = VoxelGrid(voxel)
    poses = fuse(grid, spool, predicted_depth(alignment), depth_max)
    lost = spool.frames - len(poses)
    points, colours = grid.cloud()
    if len(points) == 0:
        path.unlink(missing_ok=True)  # of an earlier run
        return None, f"no {path.name}: {spool.frames} frames, {lost} without a pose, gave no point"
    with finished_file(path) as partial:
        write_ply(partial, points, colours)
    notes = []
    if lost:
        notes.append(f"{lost} of {spool.frames} frames have no pose and are not in it")
    if grid.size != voxel:
        notes.append(f"voxels grew from {voxel:g} to {grid.size:g} m to bound its size")
    if grid.outside:
        notes.append(f"{grid.outside} points too far from the origin are left out")
    note = f"{path.name}: {'; '.join(notes)}" if notes else ""
    return FusedCloud(points, colours, poses), note


def fuse(
    grid: VoxelGrid, spool: FrameSpool, depth_of: DepthOf, depth_max: float
) -> list[Similarity]:
    """Add the points of all frames that have a pose; returns the poses."""
    poses: list[Similarity] = []
    for frame in spool:
        if frame.pose is None:
            continue
        found = depth_of(frame)
        if found is not None:
            points, colours = camera_points(frame, *found, depth_max)
            grid.add(points @ frame.pose[:3, :3].T + frame.pose[:3, 3], colours)
        poses.append(Similarity.from_matrix(frame.pose))
    return poses


def predicted_depth(alignment: Alignment) -> DepthOf:
    """The aligned depth of the run."""
    return lambda frame: (alignment.depth(frame.predicted), frame.solid)


def base_depth(alignment: Alignment) -> DepthOf:
    """The aligned depth of the base model's run."""

    def found(frame: SmallFrame) -> tuple[np.ndarray, np.ndarray] | None:
        return None if frame.base is None else (alignment.depth(frame.base[0]), frame.base[1])

    return found


def true_depth(frame: SmallFrame) -> tuple[np.ndarray, np.ndarray] | None:
    """The ground truth."""
    return None if frame.truth is None else (frame.truth, np.isfinite(frame.truth))


def camera_points(
    frame: SmallFrame, depth: np.ndarray, used: np.ndarray, depth_max: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points N x 3 (optical frame) and colours N x 3 uint8 of the used pixels within depth_max."""
    kept = used & np.isfinite(depth) & (depth > 0) & (depth <= depth_max)
    v, u = np.nonzero(kept)
    pixels = np.stack([u, v, np.ones_like(u)], axis=1) * depth[kept][:, None]
    return pixels @ np.linalg.inv(frame.matrix).T, frame.image[kept]


def cloud_view(
    spool: FrameSpool,
    fused: FusedCloud | None,
    runs: Sequence[ShownRun],
    voxel: float,
    depth_max: float,
) -> CloudView | None:
    """What the report lets people turn: the fused clouds, else those of the middle frame.

    Args:
        spool: The frames.
        fused: Of the first run; None without poses or metres.
        runs: The run, and the base model's where it was run.
        voxel: Edge of a voxel in metres.
        depth_max: Metres; farther points are left out.

    Returns:
        The clouds of the runs and of the ground truth; None without a point.
    """
    sources: dict[str, DepthOf] = {runs[0].name: predicted_depth(runs[0].alignment)}
    if spool.has_base:
        sources[runs[1].name] = base_depth(runs[1].alignment)
    sources[TRUTH] = true_depth
    if fused is None:
        return _frame_view(spool, sources, runs[0].alignment.metres, depth_max)
    clouds = {runs[0].name: PointCloud(fused.points, fused.colours)}
    for name, source in sources.items():
        if name not in clouds:
            grid = VoxelGrid(voxel, VIEW_VOXELS)
            fuse(grid, spool, source, depth_max)
            clouds[name] = PointCloud(*grid.cloud())
    return _view(clouds, fused.poses, "m", "all frames, fused")


def _frame_view(
    spool: FrameSpool, sources: dict[str, DepthOf], metres: bool, depth_max: float
) -> CloudView | None:
    frame = next(one for place, one in enumerate(spool) if place == spool.frames // 2)
    clouds = {}
    for name, source in sources.items():
        found = source(frame)
        if found is not None and (metres or name != TRUTH):
            limit = depth_max if metres else np.inf
            clouds[name] = PointCloud(*camera_points(frame, *found, limit))
    return _view(clouds, [], "m" if metres else "", "the middle frame")


def _view(
    clouds: dict[str, PointCloud], poses: Sequence[Similarity], unit: str, alt: str
) -> CloudView | None:
    known = {name: cloud for name, cloud in clouds.items() if len(cloud.points)}
    return CloudView(known, poses, unit, alt) if known else None
