"""Points triangulated from tracks and known camera poses, with honest uncertainties."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_STEPS = 3  # of Gauss-Newton
_HUBER = 2.0  # pixels beyond which a residual counts linearly
_SMALLEST = 1e-6  # of an inverse depth, 1 / metres


@dataclass(frozen=True)
class Views:
    """Earlier pictures of the same points, the latest first.

    Attributes:
        rotation, translation: K x 3 x 3 and K x 3: a point of the present camera's frame in each
            view's frame, metres.
        points: N x K x 2, normalised image coordinates (x / z, y / z) of N points; NaN where a
            point was not seen.
        rotation_variance, translation_variance: K, of the odometry's random walk from the picture
            before (for the first view: from the present picture), rad^2 and m^2, per axis.
    """

    rotation: np.ndarray
    translation: np.ndarray
    points: np.ndarray
    rotation_variance: np.ndarray
    translation_variance: np.ndarray


@dataclass(frozen=True)
class Triangulated:
    """N points in the present camera's frame.

    Attributes:
        depth: N float64, metres along the optical axis; NaN where there is no point before all of
            its cameras.
        sigma_pixels: N, standard deviation of log depth from the noise of the pixels alone.
        sigma_poses: N, of log depth from the noise of the poses alone.
        sigma_turn: N, of log depth for a further error of 1 rad in every step's rotation.
        rms: N, root mean square reprojection error in pixels.
        views: N, how many pictures see the point, the present one among them.
    """

    depth: np.ndarray
    sigma_pixels: np.ndarray
    sigma_poses: np.ndarray
    sigma_turn: np.ndarray
    rms: np.ndarray
    views: np.ndarray


def triangulate(present: np.ndarray, views: Views, pixel: float) -> Triangulated:
    """Maximum likelihood depth of points seen now and in earlier views (Huber, Gauss-Newton).

    The unknowns of a point are (x / z, y / z, 1 / z) in the present camera, in which a point far
    away is as well-behaved as a near one.

    Args:
        present: N x 2, normalised image coordinates now.
        views: the earlier pictures.
        pixel: size of a pixel in normalised coordinates (1 / focal length), the unit of the
            residuals and of the tracks' noise.

    Returns:
        See Triangulated; `sigma_pixels` is for a noise of one pixel.
    """
    seen = np.isfinite(views.points).all(axis=2)
    observed = np.where(seen[..., None], views.points, 0.0)
    unknowns = np.column_stack([present, _linear(present, views, observed, seen)])
    for _ in range(_STEPS):
        step, _, _ = _normal_equations(unknowns, present, views, observed, seen, pixel)
        unknowns = unknowns + step
        unknowns[:, 2] = np.maximum(unknowns[:, 2], _SMALLEST)
    _, covariance, last = _normal_equations(unknowns, present, views, observed, seen, pixel)
    return _judged(unknowns, present, covariance, last, views, seen, pixel)


def _judged(
    unknowns: np.ndarray,
    present: np.ndarray,
    covariance: np.ndarray,
    last: _Linearised,
    views: Views,
    seen: np.ndarray,
    pixel: float,
) -> Triangulated:
    """The estimates as depths, with what their errors may be."""
    inverse = unknowns[:, 2]
    variance = np.maximum(covariance[:, 2, 2], 0.0) * pixel**2
    poses, turn = _pose_variance(covariance, last, views, inverse)
    count = seen.sum(axis=1) + 1
    squares = last.squares.sum(axis=1) + ((unknowns[:, :2] - present) ** 2).sum(axis=1)
    good = (inverse > 2 * _SMALLEST) & np.where(seen, last.z > 0, True).all(axis=1) & (count > 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return Triangulated(
            depth=np.where(good, 1 / inverse, np.nan),
            sigma_pixels=np.where(good, np.sqrt(variance) / inverse, np.inf),
            sigma_poses=np.where(good, np.sqrt(poses) / inverse, np.inf),
            sigma_turn=np.where(good, np.sqrt(turn) / inverse, np.inf),
            rms=np.sqrt(squares / (2 * count)) / pixel,
            views=count,
        )


def _linear(
    present: np.ndarray, views: Views, observed: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """Inverse depth along the present ray that fits the other views' coordinates linearly, N."""
    rays = np.column_stack([present, np.ones(len(present))])
    turned = np.einsum("kij,nj->nki", views.rotation, rays)
    # observed (q_z + w t_z) = q_xy + w t_xy, linear in the inverse depth w
    factor = views.translation[None, :, :2] - observed * views.translation[None, :, 2:]
    right = observed * turned[..., 2:] - turned[..., :2]
    weight = seen[..., None]
    top = (weight * factor * right).sum(axis=(1, 2))
    bottom = (weight * factor**2).sum(axis=(1, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(bottom > 0, top / bottom, _SMALLEST)
    return np.asarray(np.clip(np.nan_to_num(inverse, nan=_SMALLEST), _SMALLEST, 100.0))


@dataclass(frozen=True)
class _Linearised:
    """The reprojection of N points into K views at an estimate.

    Attributes:
        weights: N x K, of Huber; 0 where a point was not seen.
        jacobian: N x K x 2 x 3, by the three unknowns.
        projected: N x K x 2.
        z: N x K, depth in each view times the inverse depth.
        squares: N x K, squared residuals; 0 where a point was not seen.
    """

    weights: np.ndarray
    jacobian: np.ndarray
    projected: np.ndarray
    z: np.ndarray
    squares: np.ndarray


def _normal_equations(
    unknowns: np.ndarray,
    present: np.ndarray,
    views: Views,
    observed: np.ndarray,
    seen: np.ndarray,
    pixel: float,
) -> tuple[np.ndarray, np.ndarray, _Linearised]:
    """Step N x 3, covariance N x 3 x 3 for residuals of variance 1, what they came from."""
    rays = np.column_stack([unknowns[:, :2], np.ones(len(unknowns))])
    q = (rays @ views.rotation.reshape(-1, 3).T).reshape(len(rays), -1, 3)
    q = q + unknowns[:, None, 2:] * views.translation[None]
    z = q[..., 2]
    safe = np.where(np.abs(z) > 1e-9, z, 1e-9)
    projected = q[..., :2] / safe[..., None]
    residual = np.where(seen[..., None], observed - projected, 0.0)
    squares = (residual**2).sum(axis=2)
    size = np.sqrt(squares) / pixel
    weights = seen * np.minimum(1.0, _HUBER / np.maximum(size, 1e-12))
    directions = np.concatenate(
        [views.rotation[:, :, :2], views.translation[:, :, None]], axis=2
    )  # K x 3 x 3: how q moves with the unknowns
    jacobian = (
        directions[None, :, :2, :] - projected[..., None] * directions[None, :, 2:, :]
    ) / safe[..., None, None]
    weighted = weights[..., None, None] * jacobian
    rows = (len(unknowns), -1, 3)
    across = weighted.reshape(rows).transpose(0, 2, 1)
    hessian = across @ jacobian.reshape(rows)
    gradient = (across @ residual.reshape(len(unknowns), -1, 1))[..., 0]
    hessian[:, [0, 1], [0, 1]] += 1.0
    gradient[:, :2] += present - unknowns[:, :2]
    hessian[:, 2, 2] += 1e-12
    covariance = _inverse(hessian)
    step = (covariance @ gradient[..., None])[..., 0]
    return step, covariance, _Linearised(weights, jacobian, projected, z, squares)


def _inverse(matrices: np.ndarray) -> np.ndarray:
    """Of N symmetric 3 x 3, by cofactors, without a call for each of them."""
    a, b, c = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 0, 2]
    d, e, f = matrices[:, 1, 1], matrices[:, 1, 2], matrices[:, 2, 2]
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    fourth, fifth, sixth = a * f - c * c, b * c - a * e, a * d - b * b
    whole = np.stack([first, second, third, second, fourth, fifth, third, fifth, sixth], axis=1)
    whole /= (a * first + b * second + c * third)[:, None]
    return whole.reshape(-1, 3, 3)


def _pose_variance(
    covariance: np.ndarray, last: _Linearised, views: Views, inverse: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Variance of the inverse depth from a random walk of the poses, and for rotations of 1 rad.

    An error of one step of the walk moves all views beyond it alike, so a step's effect is the
    sum over those views.
    """
    flat = last.jacobian.reshape(len(covariance), -1, 3) @ covariance[:, 2, :, None]
    gain = flat.reshape(last.projected.shape) * last.weights[..., None]
    u, v = last.projected[..., 0], last.projected[..., 1]
    a, b = gain[..., 0], gain[..., 1]
    turn = np.stack(
        [-a * u * v - b * (1 + v**2), a * (1 + u**2) + b * u * v, b * u - a * v], axis=-1
    )
    near = inverse[:, None] / np.where(np.abs(last.z) > 1e-9, last.z, 1e-9)
    shift = np.stack([a, b, -(a * u + b * v)], axis=-1) * near[..., None]
    turn = np.cumsum(turn[:, ::-1], axis=1)[:, ::-1]
    shift = np.cumsum(shift[:, ::-1], axis=1)[:, ::-1]
    turned = (turn**2).sum(axis=2)
    moved = (shift**2).sum(axis=2)
    variance = turned @ views.rotation_variance + moved @ views.translation_variance
    return variance, turned.sum(axis=1)
