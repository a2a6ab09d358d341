"""The PLY of a replay: every frame's points in the world, fused."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dyfn_core.evaluation.reconstruction.cloud_error import write_ply
from dyfn_core.evaluation.reconstruction.cloud_pictures import draw_fused
from dyfn_core.files import finished_file
from dyfn_core.geometry.registration import Similarity
from dyfn_core.geometry.voxel_grid import VoxelGrid
from dyfn_ros.replay.frame_spool import FrameSpool, SmallFrame
from dyfn_ros.replay.video import Alignment


def write_cloud(
    path: Path, spool: FrameSpool, alignment: Alignment, voxel: float, depth_max: float
) -> tuple[np.ndarray | None, str]:
    """Fuse the frames that have a pose into a coloured binary PLY, in metres of the poses' world.

    voxel: edge of a voxel in metres; it doubles while the cloud would be too large.
    depth_max: metres, farther points are left out. Flying pixels at depth edges are left out.
    Returns the cloud and the camera's path from above (H x W x 3 uint8 RGB, None without a point),
    and what to warn about, "" for nothing. Raises OutputError.
    """
    grid = VoxelGrid(voxel)
    poses: list[Similarity] = []
    lost = 0
    for frame in spool:
        if frame.pose is None:
            lost += 1
            continue
        grid.add(*world_points(frame, alignment, depth_max))
        poses.append(Similarity.from_matrix(frame.pose))
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
    return draw_fused(points, colours, poses), note


def world_points(
    frame: SmallFrame, alignment: Alignment, depth_max: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points N x 3 (metres, world) and colours N x 3 uint8 of the solid pixels within depth_max."""
    assert frame.pose is not None
    depth = alignment.depth(frame.predicted)
    kept = frame.solid & np.isfinite(depth) & (depth > 0) & (depth <= depth_max)
    v, u = np.nonzero(kept)
    z = depth[kept]
    pixels = np.stack([u, v, np.ones_like(u)], axis=1) * z[:, None]
    camera = pixels @ np.linalg.inv(frame.matrix).T
    world = camera @ frame.pose[:3, :3].T + frame.pose[:3, 3]
    return world, frame.image[kept]
