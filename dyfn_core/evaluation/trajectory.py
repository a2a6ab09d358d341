"""How far estimated camera poses are from known ones: ATE and RPE after Umeyama's alignment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dyfn_core.geometry.registration import RegistrationError, Similarity, procrustes

LINE = 1e-3  # a path whose second extent is below this share of its first is straight


@dataclass(frozen=True)
class TrajectoryError:
    """Errors over the frames that have both poses.

    ate: root mean square distance of the camera centres after one similarity, metres. rpe_metres,
    rpe_degrees: root mean square of the error of the motion between neighbouring frames, the
    estimate scaled by that similarity. frames: compared. alignment: estimate -> truth; None when
    the path is straight or stands still, which leaves rotations about it open (ate stays defined).
    """

    ate: float
    rpe_metres: float
    rpe_degrees: float
    frames: int
    alignment: Similarity | None


def trajectory_error(
    estimated: Sequence[Similarity | None], known: Sequence[np.ndarray | None]
) -> TrajectoryError:
    """Compare camera-to-world poses frame by frame.

    estimated: in any world and scale, None where there is none. known: 4 x 4 metres; None or not
    finite where unknown. Raises RegistrationError with fewer than 3 frames to compare, or when
    the estimate stands still; ValueError for differing lengths.
    """
    if len(estimated) != len(known):
        raise ValueError(f"{len(estimated)} estimated poses, {len(known)} known ones")
    both = [
        (index, pose, np.asarray(true, np.float64))
        for index, (pose, true) in enumerate(zip(estimated, known, strict=True))
        if pose is not None and true is not None and np.isfinite(true).all()
    ]
    centres = np.array([pose.translation for _, pose, _ in both]).reshape(-1, 3)
    truth = np.array([true[:3, 3] for _, _, true in both]).reshape(-1, 3)
    if len(both) and not np.ptp(centres, axis=0).any():
        raise RegistrationError("the estimated camera stands still: no scale can be found")
    fit = procrustes(centres, truth, with_scale=True, flat=-1)
    distances = np.linalg.norm(fit.apply(centres) - truth, axis=1)
    steps = [
        _step_error(a[1], b[1], a[2], b[2], fit.scale)
        for a, b in pairwise(both)
        if b[0] == a[0] + 1
    ]
    metres, degrees = np.array(steps).reshape(-1, 2).T if steps else (np.full(1, np.nan),) * 2
    return TrajectoryError(
        _rms(distances),
        _rms(metres),
        _rms(degrees),
        len(both),
        None if _straight(centres) or _straight(truth) else fit,
    )


def _step_error(
    a: Similarity, b: Similarity, true_a: np.ndarray, true_b: np.ndarray, scale: float
) -> tuple[float, float]:
    """Error of the motion from a to b: metres, degrees."""
    moved = scale * a.rotation.T @ (b.translation - a.translation)
    truth = np.linalg.inv(true_a) @ true_b
    turn = truth[:3, :3].T @ (a.rotation.T @ b.rotation)
    # The chord keeps its precision at small angles, where the arc cosine of the trace does not.
    chord = np.linalg.norm(turn - np.eye(3)) / np.sqrt(8)
    angle = 2 * np.degrees(np.arcsin(min(1.0, float(chord))))
    return float(np.linalg.norm(moved - truth[:3, 3])), float(angle)


def _straight(centres: np.ndarray) -> bool:
    extent = np.linalg.svd(centres - centres.mean(0), compute_uv=False)
    return bool(extent[1] <= LINE * extent[0])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
