"""How far estimated camera poses are from known ones: ATE and RPE after Umeyama's alignment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dyfn_core.geometry.registration import RegistrationError, Similarity, procrustes


@dataclass(frozen=True)
class TrajectoryError:
    """Errors over the frames that have both poses.

    ate: root mean square distance of the camera centres after one similarity, metres. rpe_metres,
    rpe_degrees: root mean square of the error of the motion between neighbouring frames, the
    estimate scaled by that similarity. frames: compared. extent: root mean square distance of the
    true centres from their mean, metres. alignment: estimate -> truth, for clouds: turned by the
    cameras' orientations, because their centres fix no turn about a straight path.
    """

    ate: float
    rpe_metres: float
    rpe_degrees: float
    frames: int
    extent: float
    alignment: Similarity


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
        _rms(np.linalg.norm(truth - truth.mean(axis=0), axis=1)),
        _oriented([pose for _, pose, _ in both], np.array([true for _, _, true in both])),
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


def _oriented(poses: Sequence[Similarity], truth: np.ndarray) -> Similarity:
    """The mean turn of the orientations, then least squares over the centres."""
    turns = [true[:3, :3] @ pose.rotation.T for pose, true in zip(poses, truth, strict=True)]
    u, _, vt = np.linalg.svd(np.sum(turns, axis=0))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    centres = np.array([pose.translation for pose in poses]) @ rotation.T
    target = truth[:, :3, 3]
    a, b = centres - centres.mean(0), target - target.mean(0)
    # A scale that is not positive would turn the cloud inside out.
    scale = max(float((a * b).sum() / (a**2).sum()), np.finfo(float).eps)
    return Similarity(rotation, target.mean(0) - scale * centres.mean(0), scale)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
