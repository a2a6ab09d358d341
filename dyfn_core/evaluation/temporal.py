"""How steady depth is over time: temporal alignment error under known poses, and flicker."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import IO

import cv2
import numpy as np

from dyfn_core.geometry.rigid import inverse
from dyfn_core.prediction import DEPTH
from dyfn_core.scoring.protocols import MIN_DEPTH, MIN_PIXELS, align_depth, sample_grid, to_shape

SAME_DEPTH = 0.01  # relative change of the truth at a pixel up to which the scene stood still there
SAME_PLACE = 1.0  # pixels that a static point may move by, where poses are known
SAME_GREY = 4.0  # of 255, change of brightness of a static pixel, where they are not
TRUTH = "truth"


@dataclass(frozen=True)
class PosedCamera:
    """A camera at one time: matrix 3 x 3 in pixels of the depth it goes with, camera to world."""

    matrix: np.ndarray
    pose: np.ndarray


def reprojection_error(
    depth: np.ndarray, other: np.ndarray, view: PosedCamera, other_view: PosedCamera
) -> tuple[float, int] | None:
    """AbsRel of `depth`, moved into the other view, against `other`; and over how many pixels.

    depth, other: H x W in the unit of the poses, not finite or <= 0 where invalid. A point falls
    on the pixel nearest to its projection; of several on one pixel the nearest to the camera
    counts. None when fewer than MIN_PIXELS meet.
    """
    moved, rows, columns = _moved(depth, view, other_view)
    height, width = other.shape
    hit = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    moved, rows, columns = moved[hit], rows[hit], columns[hit]
    order = np.argsort(-moved, kind="stable")  # the nearest is written last
    landed = np.full(other.shape, np.nan)
    landed[rows[order], columns[order]] = moved[order]
    valid = np.isfinite(landed) & _valid(other)
    if valid.sum() < MIN_PIXELS:
        return None
    return float(np.mean(np.abs(landed[valid] - other[valid]) / other[valid])), int(valid.sum())


def _valid(depth: np.ndarray) -> np.ndarray:
    result: np.ndarray = np.isfinite(depth) & (depth > 0)
    return result


def _moved(
    depth: np.ndarray, view: PosedCamera, other_view: PosedCamera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth in the other view and the row and column there, of every valid pixel in front of it."""
    v, u = np.nonzero(_valid(depth))
    z = depth[v, u].astype(np.float64)
    points, pixels = _project(u, v, z, view, other_view)
    front = points[2] > MIN_DEPTH
    columns, rows = (np.clip(np.round(axis[front]), -1e6, 1e6).astype(int) for axis in pixels)
    return points[2][front], rows, columns


def _project(
    u: np.ndarray, v: np.ndarray, z: np.ndarray, view: PosedCamera, other_view: PosedCamera
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels with depth -> points 3 x N and pixels 2 x N (float) of the other view."""
    rays = np.linalg.inv(view.matrix) @ np.stack([u, v, np.ones(len(z))])
    between = inverse(other_view.pose) @ view.pose
    points = between[:3, :3] @ (rays * z) + between[:3, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (other_view.matrix @ points)[:2] / points[2]
    return points, np.nan_to_num(pixels, nan=-1e6, posinf=1e6, neginf=-1e6)


def temporal_alignment_error(
    first: np.ndarray, second: np.ndarray, first_view: PosedCamera, second_view: PosedCamera
) -> float | None:
    """Mean of both directions' reprojection_error between two frames (Video Depth Anything's TAE).

    None when either direction has too few pixels.
    """
    there = reprojection_error(first, second, first_view, second_view)
    back = reprojection_error(second, first, second_view, first_view)
    return None if there is None or back is None else (there[0] + back[0]) / 2


def flicker(first: np.ndarray, second: np.ndarray, static: np.ndarray) -> float | None:
    """Mean |second - first| / first over the static pixels; None for fewer than MIN_PIXELS."""
    usable = static & _valid(first) & _valid(second)
    if usable.sum() < MIN_PIXELS:
        return None
    return float(np.mean(np.abs(second[usable] - first[usable]) / first[usable]))


def static_pixels(
    first: np.ndarray,
    second: np.ndarray,
    views: tuple[PosedCamera, PosedCamera] | None = None,
    greys: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """H x W bool: where two neighbouring frames show one point of the scene at one place.

    first, second: true depth H x W; it must be known in both frames and differ by SAME_DEPTH at
    most. views: the known cameras; the true point must then move by SAME_PLACE pixels at most.
    greys: H x W brightness; without views it must change by SAME_GREY at most.
    """
    valid = _valid(first) & _valid(second)
    with np.errstate(invalid="ignore", divide="ignore"):
        static: np.ndarray = valid & (np.abs(second - first) <= SAME_DEPTH * first)
    if views is not None:
        v, u = np.nonzero(static)
        _, pixels = _project(u, v, first[v, u].astype(np.float64), *views)
        static[v, u] = np.hypot(pixels[0] - u, pixels[1] - v) <= SAME_PLACE
    elif greys is not None:
        static &= np.abs(greys[1].astype(np.float64) - greys[0]) <= SAME_GREY
    return static


class TemporalScorer:
    """Both measures for several predictions of one sequence, once their alignment is known.

    Frames are sampled on a grid of at most `samples` points and wait in a temporary file, so that
    memory does not grow with the sequence. Truth itself is measured too, as `truth`: what is left
    there is occlusion, motion of the scene and the grid, which no prediction can avoid.
    Close it, or use it in a `with` statement.
    """

    def __init__(self, samples: int = 20_000) -> None:
        self.samples = samples
        self._file: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - lives until close()
        self._views: list[PosedCamera | None] = []
        self._shapes: list[tuple[int, int]] = []
        self._names: tuple[str, ...] = ()

    def push(
        self,
        image: np.ndarray,
        truth: np.ndarray,
        predictions: Mapping[str, np.ndarray],
        camera_matrix: np.ndarray | None,
        pose: np.ndarray | None,
    ) -> None:
        """One frame: image H x W x 3, truth h x w, predictions h x w (invalid: NaN), camera_matrix
        in pixels of the image. The names must be those of the first frame."""
        grid = sample_grid(truth.shape, self.samples)
        kept = truth[grid]
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        maps = [to_shape(grey, truth.shape)[grid], kept, *(p[grid] for p in predictions.values())]
        if not self._names:
            self._names = (TRUTH, *predictions)
        for values in maps:
            self._file.write(np.ascontiguousarray(values, np.float32).tobytes())
        self._shapes.append((kept.shape[0], kept.shape[1]))
        known = camera_matrix is not None and pose is not None
        view = None
        if known and camera_matrix is not None and pose is not None:
            view = PosedCamera(_on_grid(camera_matrix, image.shape, truth.shape, grid), pose)
        self._views.append(view)

    def results(
        self, alignments: Mapping[str, tuple[float, float, str]]
    ) -> dict[str, dict[str, float | int | None]]:
        """Name (and `truth`) -> tae, tae_pairs, flicker, flicker_pairs; means over frame pairs.

        alignments: name -> scale, shift and quantity of the video protocol's fit. A measure is
        None when no pair of neighbours allows it (no poses; nothing stands still).
        """
        full = {TRUTH: (1.0, 0.0, DEPTH), **alignments}
        found: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in full}
        previous: tuple[np.ndarray, dict[str, np.ndarray]] | None = None
        for index, (grey, maps) in enumerate(self._read(full)):
            if previous is not None and previous[0].shape == grey.shape:
                self._compare(index, previous, (grey, maps), found)
            previous = (grey, maps)
        return {
            name: {
                "tae": float(np.mean(tae)) if tae else None,
                "tae_pairs": len(tae),
                "flicker": float(np.mean(change)) if change else None,
                "flicker_pairs": len(change),
            }
            for name, (tae, change) in found.items()
        }

    def _compare(
        self,
        index: int,
        previous: tuple[np.ndarray, dict[str, np.ndarray]],
        present: tuple[np.ndarray, dict[str, np.ndarray]],
        found: dict[str, tuple[list[float], list[float]]],
    ) -> None:
        first, second = self._views[index - 1], self._views[index]
        views = None if first is None or second is None else (first, second)
        truths = previous[1][TRUTH], present[1][TRUTH]
        static = static_pixels(*truths, views, (previous[0], present[0]))
        for name, (tae, change) in found.items():
            pair = previous[1][name], present[1][name]
            error = None if views is None else temporal_alignment_error(*pair, *views)
            if error is not None:
                tae.append(error)
            moved = flicker(*pair, static)
            if moved is not None:
                change.append(moved)

    def _read(
        self, alignments: Mapping[str, tuple[float, float, str]]
    ) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Each frame's brightness and its maps by name, aligned; NaN where truth or map is not."""
        self._file.seek(0)
        for height, width in self._shapes:
            stored = [
                np.frombuffer(self._file.read(4 * height * width), np.float32).reshape(
                    height, width
                )
                for _ in range(len(self._names) + 1)
            ]
            truth = stored[1]
            maps = {}
            for name, values in zip(self._names, stored[1:], strict=True):
                if name in alignments:
                    aligned = align_depth(values, *alignments[name])
                    maps[name] = np.where(_valid(truth), np.maximum(aligned, MIN_DEPTH), np.nan)
            yield stored[0], maps

    def close(self) -> None:
        """Remove the temporary file."""
        self._file.close()

    def __enter__(self) -> TemporalScorer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _on_grid(
    matrix: np.ndarray,
    image_shape: tuple[int, ...],
    shape: tuple[int, ...],
    grid: tuple[slice, slice],
) -> np.ndarray:
    """A camera matrix in pixels of the image -> in points of the grid on the truth."""
    step, start = grid[0].step, grid[0].start
    result: np.ndarray = matrix.astype(np.float64).copy()
    for row, axis in ((0, 1), (1, 0)):
        scale = shape[axis] / image_shape[axis]
        result[row] *= scale
        result[row, 2] += (scale - 1) / 2  # the first pixel's centre is 0
        result[row, 2] -= start
        result[row] /= step
    return result
