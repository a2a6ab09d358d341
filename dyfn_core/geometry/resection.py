"""A camera's motion from points that it saw before and their pixels now, outliers included."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

_HYPOTHESES = 200
_ITERATIONS = 12
_STILL = 1e-5  # radians, and shares of the median depth: the iteration has settled
_LEAST_DEPTH = 0.05  # of the median depth; nearer points are taken to be there
_STAY = 2.0  # weight of "the camera did not move", as of so many points a median depth away
FEWEST = 8


@dataclass(frozen=True)
class Resection:
    """The points in the camera's frame now.

    Attributes:
        points: N x 3.
        errors: N, reprojection errors in pixels.
        inliers: N bool, of the consensus that the motion was found from.
    """

    points: np.ndarray
    errors: np.ndarray
    inliers: np.ndarray


def resect(points: np.ndarray, rays: np.ndarray, focal: float, most: float) -> Resection | None:
    """The rigid motion of N points that projects them where they are seen.

    A consensus of four-point hypotheses (EPnP, OpenCV's fixed random numbers), then reweighted
    least squares. Deterministic.

    Args:
        points: N x 3, in the frame of the picture before, any unit.
        rays: N x 2, (x / z, y / z) where they are seen now.
        focal: Pixels of one unit of rays.
        most: Pixels; a pair with a larger reprojection error is an outlier.

    Returns:
        The points moved; None when fewer than FEWEST pairs agree.
    """
    if len(points) < FEWEST:
        return None
    camera = np.diag([focal, focal, 1.0])
    found, turn, shift, kept = cv2.solvePnPRansac(
        points.reshape(-1, 1, 3),
        (rays * focal).reshape(-1, 1, 2),
        camera,
        None,
        iterationsCount=_HYPOTHESES,
        reprojectionError=most,
        flags=cv2.SOLVEPNP_EPNP,
    )
    if not found or kept is None or len(kept) < FEWEST:
        return None
    inliers = np.zeros(len(points), bool)
    inliers[kept[:, 0]] = True
    pose = (cv2.Rodrigues(turn)[0], shift[:, 0])
    rotation, translation = _refined(points[inliers], rays[inliers], focal, pose)
    moved = points @ rotation.T + translation
    errors = np.linalg.norm(_missed(moved, rays, focal, points), axis=1)
    return Resection(moved, errors, inliers & (errors < most) & (moved[:, 2] > 0))


def _missed(moved: np.ndarray, rays: np.ndarray, focal: float, points: np.ndarray) -> np.ndarray:
    """N x 2 pixels from where points are seen to where they project."""
    least = _LEAST_DEPTH * np.median(points[:, 2])
    return np.asarray((moved[:, :2] / np.maximum(moved[:, 2:], least) - rays) * focal)


def _refined(
    points: np.ndarray, rays: np.ndarray, focal: float, pose: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation of the least reprojection error, far ones counted little."""
    rotation, translation = pose
    unit = float(np.median(points[:, 2]))
    for _ in range(_ITERATIONS):
        moved = points @ rotation.T + translation
        missed = _missed(moved, rays, focal, points)
        sizes = np.linalg.norm(missed, axis=1)
        weights = 1 / (1 + (sizes / max(1.0, 1.5 * float(np.median(sizes)))) ** 2) ** 2
        slope = _slopes(moved, translation, unit, focal)
        normal = np.einsum("n,nij,nik->jk", weights, slope, slope)
        normal += 1e-6 * len(points) * np.eye(6)
        normal[3:, 3:] += _STAY * np.eye(3)
        right = np.einsum("n,nij,ni->j", weights, slope, missed)
        right[3:] += _STAY * translation / unit
        change = -np.linalg.solve(normal, right)
        rotation = cv2.Rodrigues(change[:3])[0] @ rotation
        translation = translation + change[3:] * unit
        if np.abs(change).max() < _STILL:
            break
    return rotation, translation


def _slopes(moved: np.ndarray, translation: np.ndarray, unit: float, focal: float) -> np.ndarray:
    """N x 2 x 6: how reprojection errors change with a turn and with a step in medians of depth."""
    inverse = 1 / np.maximum(moved[:, 2], _LEAST_DEPTH * unit)
    project = np.zeros((len(moved), 2, 3))
    project[:, 0, 0] = project[:, 1, 1] = inverse
    project[:, :, 2] = -moved[:, :2] * (inverse**2)[:, None]
    x, y, z = (moved - translation).T
    none = np.zeros(len(moved))
    turned = np.stack([[none, z, -y], [-z, none, x], [y, -x, none]]).transpose(2, 0, 1)
    return np.asarray(np.concatenate([project @ turned, project * unit], axis=2) * focal)
