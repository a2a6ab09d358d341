"""Camera poses and one fused cloud from predicted point maps (paper section 5)."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np

from dyfn_core.evaluation.choices import OFFSETS
from dyfn_core.evaluation.reconstruction.matching import MatchWindow, partners, sample_at
from dyfn_core.geometry.edges import flying_pixels
from dyfn_core.geometry.registration import (
    Consensus,
    RegistrationError,
    Similarity,
    procrustes,
    ransac_procrustes,
)
from dyfn_core.geometry.voxel_grid import VoxelGrid

EDGE_SHARE = 0.1  # a step in depth that pixels hang in; they are neither matched nor fused


@dataclass(frozen=True)
class ReconstructionOptions:
    """offsets: frames back to match with. threshold: largest distance of an inlier as a share of
    its depth. with_scale: poses are similarities, so that every frame may have its own scale.
    voxel: edge as a share of the first frame's median depth. stride: of the pixels fused."""

    offsets: tuple[int, ...] = OFFSETS
    threshold: float = 0.05
    with_scale: bool = False
    voxel: float = 0.01
    max_voxels: int = 500_000
    stride: int = 2
    max_hypotheses: int = 512
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.offsets or min(self.offsets) < 1:
            raise ValueError(f"offsets must be frames back, at least 1, got {self.offsets}")
        for name in ("threshold", "voxel", "max_voxels", "stride", "max_hypotheses"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be above 0, got {getattr(self, name)}")


@dataclass(frozen=True)
class FramePose:
    """What was found for one frame.

    pose: camera to world, the world being the first frame that had points; None when there is
    none, and then `problem` says why. pairs, inliers: of all its partners together. partners:
    frames back whose consensus the pose rests on.
    """

    pose: Similarity | None
    pairs: int = 0
    inliers: int = 0
    partners: tuple[int, ...] = ()
    problem: str | None = None


@dataclass(frozen=True)
class _Kept:
    """An earlier frame: its points H x W x 3 float32, NaN where not to be used, and its pose."""

    points: np.ndarray
    pose: Similarity | None


@dataclass
class Reconstruction:
    """Takes point maps one frame at a time; finds each frame's pose and fuses the points.

    Each partner gives 3D-3D pairs and, by RANSAC, a pose. The candidates compete on the pairs of
    all partners, taken into the world by the partners' own poses; the best supported one is
    fitted again to all the pairs that agree with it. A frame without a pose is not fused and is
    no partner. Memory: the points of the last max(offsets) frames, and the voxels.

    frames: one entry a frame pushed. cloud: None until a frame had points.
    """

    options: ReconstructionOptions = field(default_factory=ReconstructionOptions)
    frames: list[FramePose] = field(default_factory=list)
    cloud: VoxelGrid | None = None
    _kept: deque[_Kept] = field(init=False)

    def __post_init__(self) -> None:
        self._kept = deque(maxlen=max(self.options.offsets))

    def push(
        self,
        image: np.ndarray,
        points: np.ndarray,
        valid: np.ndarray,
        window: MatchWindow,
        known: Similarity | None = None,
    ) -> FramePose:
        """The next frame.

        image: H x W x 3 uint8 RGB, already pushed to window. points: H x W x 3, optical frame, up
        to scale. valid: H x W bool. known: the frame's true pose, which the first frame takes and
        later frames register to in place of the one found; then points are in its unit. Raises
        ValueError when the window does not reach far enough or the shapes differ.
        """
        if image.shape[:2] != points.shape[:2] or valid.shape != points.shape[:2]:
            raise ValueError(
                f"image {image.shape}, points {points.shape} and valid {valid.shape} differ in size"
            )
        if window.reach < max(self.options.offsets):
            raise ValueError(
                f"matches reach {window.reach} back, not to {max(self.options.offsets)}"
            )
        usable = valid & np.isfinite(points).all(-1) & (points[..., 2] > 0)
        usable &= ~flying_pixels(points[..., 2], usable, EDGE_SHARE)
        clean = np.where(usable[..., None], points, np.nan).astype(np.float32)
        first = self.cloud is None
        found = self._first(clean, known) if first else self._pose(clean, window)
        self.frames.append(found)
        self._kept.append(_Kept(clean, found.pose if known is None else known))
        if found.pose is not None and self.cloud is not None:
            step = self.options.stride
            chosen = np.isfinite(clean[::step, ::step, 2])
            self.cloud.add(
                found.pose.apply(clean[::step, ::step][chosen]), image[::step, ::step][chosen]
            )
        return found

    @property
    def poses(self) -> list[Similarity | None]:
        """Camera to world for every frame, None where it could not be found."""
        return [frame.pose for frame in self.frames]

    def problems(self) -> dict[str, int]:
        """Why frames have no pose -> how many."""
        return dict(Counter(f.problem.split(":")[0] for f in self.frames if f.problem is not None))

    def _first(self, points: np.ndarray, known: Similarity | None) -> FramePose:
        depth = points[..., 2][np.isfinite(points[..., 2])]
        if not depth.size:
            return FramePose(None, problem="no valid point")
        size = self.options.voxel * float(np.median(depth))
        self.cloud = VoxelGrid(size, self.options.max_voxels)
        return FramePose(Similarity.identity() if known is None else known)

    def _pose(self, points: np.ndarray, window: MatchWindow) -> FramePose:
        chosen = partners(self.options.offsets, [kept.pose is not None for kept in self._kept])
        if not chosen:
            return FramePose(None, problem="lost: no frame with a pose in reach")
        candidates: list[Similarity] = []
        pairs: list[tuple[np.ndarray, np.ndarray]] = []
        agreed, problems, total = [], [], 0
        for offset in chosen:
            source, target = self._pairs(points, offset, window)
            total += len(source)
            try:
                consensus = self._consensus(source, target)
            except RegistrationError as error:
                problems.append(str(error))
                continue
            earlier = self._kept[-offset].pose
            assert earlier is not None
            candidates.append(earlier.after(consensus.transform))
            pairs.append((source[consensus.inliers], earlier.apply(target[consensus.inliers])))
            agreed.append(offset)
        if not candidates:
            return FramePose(None, total, problem=problems[0])
        pose, inliers = self._fuse(candidates, pairs)
        return FramePose(pose, total, inliers, tuple(agreed))

    def _pairs(
        self, points: np.ndarray, offset: int, window: MatchWindow
    ) -> tuple[np.ndarray, np.ndarray]:
        """Points of this frame and the same ones in the partner's camera, both N x 3 float64."""
        matches = window.back(offset)
        source = sample_at(points, matches.first)
        target = sample_at(self._kept[-offset].points, matches.second)
        both = np.isfinite(source).all(1) & np.isfinite(target).all(1)
        return source[both], target[both]

    def _consensus(self, source: np.ndarray, target: np.ndarray) -> Consensus:
        return ransac_procrustes(
            source,
            target,
            self.options.threshold * target[:, 2],
            with_scale=self.options.with_scale,
            seed=self.options.seed + len(self.frames),
            max_hypotheses=self.options.max_hypotheses,
        )

    def _fuse(
        self, candidates: list[Similarity], pairs: list[tuple[np.ndarray, np.ndarray]]
    ) -> tuple[Similarity, int]:
        """The candidate that the pairs of all partners support best, fitted to its inliers."""
        source, world = (np.concatenate(parts) for parts in zip(*pairs, strict=True))

        def error(pose: Similarity) -> np.ndarray:
            """In units of the threshold."""
            limit = self.options.threshold * pose.scale * source[:, 2]
            return np.asarray(np.linalg.norm(pose.apply(source) - world, axis=1) / limit)

        errors = [error(pose) for pose in candidates]
        best = int(np.argmin([np.minimum(e**2, 1).sum() for e in errors]))
        inliers = errors[best] <= 1
        pose = procrustes(source[inliers], world[inliers], with_scale=self.options.with_scale)
        return pose, int((error(pose) <= 1).sum())
