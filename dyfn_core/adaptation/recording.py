"""A recording reduced to what adaptation needs: latents, triangulated points, true depth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor
from tqdm import tqdm

from dyfn_core.data.frames import DataError
from dyfn_core.data.posed import PosedFrame, PosedRecording
from dyfn_core.files import finished_file
from dyfn_core.geometry.camera import normalize_intrinsics
from dyfn_core.metric.motion import (
    MotionOptions,
    MotionPoints,
    MotionState,
    observe,
    point_weights,
)
from dyfn_core.models.base import GeometryModel, Latent, image_to_batch

MOST_POINTS = 400  # of a frame, the most certain ones
MOST_SIGMA = 0.12  # standard deviation of log depth beyond which a point is left out
EDGE = 0.2  # range of predicted log depth around a point beyond which it may be on either side
AROUND = 5  # pixels of half the network's size that the range is taken over
FEWEST = 16  # points without which a frame says nothing
FEWEST_FRAMES = 16  # with points, without which a recording says nothing
GAP = 2.0  # seconds between frames that end a stretch


@dataclass(frozen=True)
class SparseFrames:
    """N frames of one recording, in the order of time.

    Attributes:
        name: Of the recording.
        latent: N x C x h x w float16.
        place: N x P x 2 float32, where points are: (x, y) from -1 to 1 over the picture.
        depth: N x P float32 metres, NaN beyond a frame's points.
        weight: N x P float32, see metric.motion.point_weights; 0 beyond.
        truth: N x H/2 x W/2 float16 metres of the network's (H, W), NaN where unknown.
        stamps: N float64, seconds.
        starts: Frames that a stream begins with, the first among them.
        camera: 3 x 3 float64, normalised.
        network_size: (H, W) that the latents are of.
        image_size: (H, W) of the pictures.
        problems: What was not used, with how often.
    """

    name: str
    latent: Tensor
    place: Tensor
    depth: Tensor
    weight: Tensor
    truth: Tensor
    stamps: Tensor
    starts: tuple[int, ...]
    camera: np.ndarray
    network_size: tuple[int, int]
    image_size: tuple[int, int]
    problems: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.latent)

    @property
    def seen(self) -> Tensor:
        """N bool: the frames that have enough points."""
        return torch.isfinite(self.depth).sum(1) >= FEWEST

    @property
    def has_truth(self) -> bool:
        """Whether a depth sensor was recorded as well."""
        return bool(torch.isfinite(self.truth).any())


def reduce_recording(
    recording: PosedRecording, model: GeometryModel, rate: float, told: bool = True
) -> SparseFrames:
    """Read a recording once: every frame is tracked, some are encoded.

    Args:
        recording: With poses.
        model: Its encoder is used.
        rate: Frames a second that are kept.
        told: Whether a progress bar is drawn.

    Raises:
        DataError: It has no frames, pictures of several sizes, or hardly any points; the message
            has the reasons.
    """
    kept = _Kept(recording.name)
    frames = tqdm(
        recording.frames(), f"reading {recording.name}", recording.expected, disable=not told
    )
    for frame, points, begins in _tracked(frames, kept):
        if begins or frame.stamp - kept.stamps[-1] > 0.999 / rate:
            kept.add(frame, points, begins, model)
    return kept.result(dict(recording.problems))


def _tracked(
    frames: Iterator[PosedFrame], kept: _Kept
) -> Iterator[tuple[PosedFrame, MotionPoints, bool]]:
    """Each frame, its points, and whether a stretch begins with it."""
    options, state, before = MotionOptions(), MotionState(), -np.inf
    for frame in frames:
        begins = not before <= frame.stamp <= before + GAP
        state = MotionState() if begins else state
        before = frame.stamp
        state, points = observe(
            state,
            np.ascontiguousarray(frame.image),
            frame.camera_matrix,
            frame.pose,
            options,
            frame.pose_variance,
            frame.visible,
        )
        if points.problem:
            # The number in it differs from frame to frame.
            kept.count(f"odometry {points.problem.split(':')[0]}")
        yield frame, points, begins


class _Kept:
    """Takes the frames one by one."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.stamps: list[float] = []
        self._latents: list[Tensor] = []
        self._points: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self._truth: list[Tensor] = []
        self._starts: list[int] = []
        self._problems: dict[str, int] = {}
        self._first: tuple[tuple[int, int], tuple[int, int], np.ndarray] | None = None

    def count(self, reason: str) -> None:
        self._problems[reason] = self._problems.get(reason, 0) + 1

    @torch.no_grad()
    def add(
        self, frame: PosedFrame, points: MotionPoints, begins: bool, model: GeometryModel
    ) -> None:
        size = (frame.image.shape[0], frame.image.shape[1])
        latent = model.encode(image_to_batch(frame.image, model.device)[0])
        if self._first is None:
            camera = normalize_intrinsics(frame.camera_matrix, size)
            self._first = (size, latent.network_size, camera)
        if size != self._first[0]:
            raise DataError(f"{self.name}: pictures of {self._first[0]} and of {size}")
        if begins:
            self._starts.append(len(self.stamps))
        self.stamps.append(frame.stamp)
        self._latents.append(latent.features[0].half().cpu())
        self._points.append(_chosen(points, size, _edges(model, latent)))
        self._truth.append(_truth(frame.depth, latent.network_size))

    def result(self, problems: dict[str, int]) -> SparseFrames:
        told = {**problems, **self._problems}
        reasons = "; ".join(f"{count} x {text}" for text, count in told.items())
        if self._first is None:
            raise DataError(f"{self.name}: no frame could be used: {reasons or 'it has none'}")
        size, network_size, camera = self._first
        count = len(self.stamps)
        place = torch.zeros(count, MOST_POINTS, 2)
        depth = torch.full((count, MOST_POINTS), torch.nan)
        weight = torch.zeros(count, MOST_POINTS)
        for index, parts in enumerate(self._points):
            for whole, part in zip((place, depth, weight), parts, strict=True):
                whole[index, : len(part)] = torch.from_numpy(part)
        found = SparseFrames(
            self.name,
            torch.stack(self._latents),
            place,
            depth,
            weight,
            torch.stack(self._truth),
            torch.tensor(self.stamps, dtype=torch.float64),
            tuple(self._starts),
            camera,
            network_size,
            size,
            told,
        )
        if int(found.seen.sum()) < FEWEST_FRAMES:
            raise DataError(
                f"{self.name}: {int(found.seen.sum())} of {count} frames have {FEWEST} "
                f"triangulated points: the camera has to move, and its odometry to agree with the "
                f"pictures{': ' if reasons else ''}{reasons}"
            )
        return found


def _edges(model: GeometryModel, latent: Latent) -> np.ndarray:
    """H/2 x W/2 bool: where the model without DyFN sees one thing before another."""
    rows, columns = latent.network_size[0] // 2, latent.network_size[1] // 2
    affine = model.decode(replace(latent, image_size=(rows, columns)))
    logs = np.log(np.maximum(affine.values[0].float().cpu().numpy(), 1e-6))
    around = np.ones((AROUND, AROUND), np.uint8)
    return np.asarray(cv2.dilate(logs, around) - cv2.erode(logs, around) > EDGE)


def _chosen(
    points: MotionPoints, size: tuple[int, int], edges: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, depths and weights of the usable points, float32."""
    shares = (points.pixels + 0.5) / [size[1], size[0]]
    x, y = (np.clip(shares, 0, 0.999) * edges.shape[::-1]).astype(int).T
    good = np.isfinite(points.depth) & (points.sigma < MOST_SIGMA) & ~edges[y, x]
    chosen = np.flatnonzero(good)
    chosen = chosen[np.argsort(points.sigma[chosen], kind="stable")[:MOST_POINTS]]
    weight: np.ndarray = np.empty(0)
    if len(chosen):
        weight = point_weights(points.pixels[chosen], points.sigma[chosen], size)
    place, depth = shares[chosen] * 2 - 1, points.depth[chosen]
    return place.astype(np.float32), depth.astype(np.float32), weight.astype(np.float32)


def _truth(depth: np.ndarray | None, network_size: tuple[int, int]) -> Tensor:
    """Nearest samples at half the network's size."""
    rows, columns = network_size[0] // 2, network_size[1] // 2
    if depth is None:
        return torch.full((rows, columns), torch.nan, dtype=torch.float16)
    row = (np.arange(rows) * 2 + 1) * depth.shape[0] // (2 * rows)
    column = (np.arange(columns) * 2 + 1) * depth.shape[1] // (2 * columns)
    return torch.from_numpy(depth[row[:, None], column].astype(np.float16))


def save_frames(frames: SparseFrames, path: Path) -> None:
    """Write to a file that load_frames reads."""
    tensors = {name: value for name, value in vars(frames).items() if isinstance(value, Tensor)} | {
        "camera": torch.from_numpy(frames.camera)
    }
    numbers = [*frames.network_size, *frames.image_size]
    tensors["sizes"] = torch.tensor(numbers)
    tensors["starts"] = torch.tensor(frames.starts)
    notes = {f"problem {text}": str(count) for text, count in frames.problems.items()}
    with finished_file(path) as partial:
        save_file(tensors, partial, {"name": frames.name, **notes})


def load_frames(path: Path) -> SparseFrames:
    """What save_frames wrote."""
    with safe_open(path, "pt") as file:
        notes = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    sizes = tensors.pop("sizes").tolist()
    starts = tuple(tensors.pop("starts").tolist())
    camera = tensors.pop("camera").numpy()
    problems = {
        text.removeprefix("problem "): int(count)
        for text, count in notes.items()
        if text.startswith("problem ")
    }
    return SparseFrames(
        name=notes["name"],
        **tensors,
        starts=starts,
        camera=camera,
        network_size=(sizes[0], sizes[1]),
        image_size=(sizes[2], sizes[3]),
        problems=problems,
    )
