"""The metric scale of a frame from the camera's own motion: tracks, triangulation, log ratios."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from dyfn_core.geometry.camera import check_camera_matrix
from dyfn_core.geometry.rigid import size_of
from dyfn_core.geometry.tracks import TrackerState, TrackOptions, Tracks, track
from dyfn_core.geometry.triangulation import Triangulated, Views, triangulate

_CELLS = (6, 8)  # rows and columns of the grid that a measurement is evened out over
_FLOOR = 0.15  # of a point's sigma, from the shape of the predicted depth
_LEAST_NOISE = 0.08  # of a measured log scale
_NEIGHBOURS = 5  # points whose log ratios err alike
_TURN = math.radians(0.1), 0.02  # odometry's own noise: radians, and share of the rotation
_STEP = 1e-3, 0.01  # metres, and share of the translation
_TRUST = 0.25  # of the usual variances, which an odometry's own account may go down to
_SHARED = 0.6  # of the latest view's tracks; with fewer left, the picture becomes a view
_AROUND = 0.02  # of the picture's longer side, within which the predicted surfaces may be a point's
_EITHER = 0.5  # of their range of log depth, which a point's sigma grows by
_RIGID = 1e-3  # most that a pose's rotation may miss an orthonormal matrix by


@dataclass(frozen=True)
class MotionOptions:
    """How points are triangulated, and which of them count.

    Attributes:
        tracks: how points are followed.
        views: earlier pictures that a point is triangulated from, at most.
        parallax: median parallax, in pixels of the tracking size, after which a picture is kept
            as a view.
        pixel_noise: standard deviation of a track, in pixels of the tracking size.
        most_rms: pixels of the tracking size beyond which a point's reprojection error excludes
            it.
        trusted_rms: pixels of the tracking size. With a larger median reprojection error of all
            tracks, the odometry contradicts the pictures and the frame has no points.
        lost_rms: the same, beyond which the odometry is taken to have jumped: the views before
            are forgotten.
        scale_sigma: largest standard deviation of log depth of a point that the scale is measured
            with.
        fewest: points that a measurement needs.
        share: of the points it could be made with. Where the camera has hardly moved, the few that
            seem certain are those whose noise makes them near.
        most_spread: robust standard deviation of the log ratios beyond which they say nothing.
    """

    tracks: TrackOptions = field(default_factory=TrackOptions)
    views: int = 10
    parallax: float = 3.0
    pixel_noise: float = 0.5
    most_rms: float = 2.0
    trusted_rms: float = 1.0
    lost_rms: float = 5.0
    scale_sigma: float = 0.2
    fewest: int = 8
    share: float = 0.2
    most_spread: float = 0.35


@dataclass(frozen=True)
class View:
    """A picture that later points are triangulated from.

    Attributes:
        tracks: ids and normalised coordinates (x / z, y / z) of its points.
        pose: 4 x 4, camera to world, metres.
        rotation_variance: of the odometry from the view before it to this one, per axis, rad^2.
        translation_variance: the same of the translation, m^2.
    """

    tracks: Tracks
    pose: np.ndarray
    rotation_variance: float = 0.0
    translation_variance: float = 0.0


@dataclass(frozen=True)
class MotionState:
    """All that is remembered between two frames; a value.

    Attributes:
        tracker: of the last picture; None before the first one.
        views: kept pictures, the latest first.
        pose: of the last picture that had a usable one.
        posed: whether that was the last picture.
        rotation_variance: from the latest view to `pose`, per axis, rad^2.
        translation_variance: the same of the translation, m^2.
        pose_variance: what the odometry said of `pose`, see `observe`.
    """

    tracker: TrackerState | None = None
    views: tuple[View, ...] = ()
    pose: np.ndarray | None = None
    posed: bool = False
    rotation_variance: float = 0.0
    translation_variance: float = 0.0
    pose_variance: tuple[float, float] | None = None


def _none() -> np.ndarray:
    return np.empty(0)


@dataclass(frozen=True)
class MotionPoints:
    """Triangulated points of one frame.

    Attributes:
        ids: N, of their tracks.
        pixels: N x 2, (x, y) in the picture.
        depth: N, metres along the optical axis.
        sigma_pixels: N, standard deviation of log depth from the noise of the pixels.
        sigma: N, the same from the noise of pixels and poses.
        rms: median reprojection error of all tracks of the window, in pixels of the tracking
            size; NaN without tracks.
        tracked: how many tracks reach this picture.
        problem: why there are no points, where the pose is the reason; else empty.
    """

    ids: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))
    pixels: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    depth: np.ndarray = field(default_factory=_none)
    sigma_pixels: np.ndarray = field(default_factory=_none)
    sigma: np.ndarray = field(default_factory=_none)
    rms: float = math.nan
    tracked: int = 0
    problem: str = ""


@dataclass(frozen=True)
class ScaleMeasurement:
    """log(metres / unit) of one frame.

    Attributes:
        log_scale: the measurement.
        variance: of its noise.
        points: how many it was made with.
        spread: robust standard deviation of their log ratios.
    """

    log_scale: float
    variance: float
    points: int
    spread: float


def observe(
    state: MotionState,
    image: np.ndarray,
    camera_matrix: np.ndarray,
    pose: np.ndarray | None,
    options: MotionOptions,
    pose_variance: tuple[float, float] | None = None,
    visible: np.ndarray | None = None,
) -> tuple[MotionState, MotionPoints]:
    """Follow the tracks into the next picture and triangulate what has moved enough.

    A pose that is unknown, not finite or not rigid gives no points; the tracks go on.

    Args:
        state: after the picture before; it is not changed.
        image: H x W x 3 uint8 RGB, without lens distortion.
        camera_matrix: 3 x 3, pixels of the image.
        pose: 4 x 4, camera to world, optical axes (x right, y down, z forward), metres; None when
            unknown.
        options: see MotionOptions.
        pose_variance: rotation (rad^2) and translation (m^2) per axis, accumulated along the way
            to this pose by the odometry's own account; None: see step_variance.
        visible: H x W bool, where the image shows something; None: everywhere.

    Returns:
        The state after this picture, and the points it sees.

    Raises:
        ValueError: the camera matrix is no pinhole camera's, or the pose is not 4 x 4.
    """
    camera_matrix = check_camera_matrix(camera_matrix)
    problem = "no pose of the camera" if pose is None else pose_problem(np.asarray(pose))
    if pose is None or problem:
        tracker = track(state.tracker, image, options.tracks, visible=visible)
        tracked = len(tracker.tracks.ids)
        state = replace(state, tracker=tracker, posed=False)
        return state, MotionPoints(tracked=tracked, problem=problem)
    pose = np.array(pose, np.float64)  # the caller may write to its own later
    state, turn = _advanced(state, camera_matrix, pose, pose_variance)
    tracker = track(state.tracker, image, options.tracks, turn, visible)
    state = replace(state, tracker=tracker)
    present = _normalised(tracker.tracks, camera_matrix)
    pixel = _pixel(image, camera_matrix, options)
    views = _views(state, present, pose)
    points = _points(views, present, tracker.tracks, pixel, options)
    if points.rms > options.lost_rms:
        state = replace(state, views=())
    if _is_view(state, views, present, pixel, options):
        view = View(present, pose, state.rotation_variance, state.translation_variance)
        kept = (view, *state.views[: options.views - 1])
        state = replace(state, views=kept, rotation_variance=0.0, translation_variance=0.0)
    return state, points


def pose_problem(pose: np.ndarray) -> str:
    """Why a pose cannot be used; empty when it can.

    Args:
        pose: 4 x 4.

    Raises:
        ValueError: it has another shape.
    """
    if pose.shape != (4, 4):
        raise ValueError(f"pose must be 4 x 4 (camera to world), got shape {pose.shape}")
    if not np.isfinite(pose).all():
        return "the pose has values that are not finite"
    rotation = pose[:3, :3]
    rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() < _RIGID
    rigid = rigid and np.linalg.det(rotation) > 0
    if not rigid or np.abs(pose[3] - [0, 0, 0, 1]).max() > _RIGID:
        return "the pose is not a rotation and a translation"
    return ""


def step_variance(relative: np.ndarray) -> tuple[float, float]:
    """What odometry without a covariance is taken to err by between two frames.

    Args:
        relative: 4 x 4 motion from one frame to the next, metres.

    Returns:
        Variance of the rotation (rad^2) and of the translation (m^2), per axis.
    """
    angle, distance = size_of(relative)
    rotation = _TURN[0] ** 2 + (_TURN[1] * angle) ** 2
    translation = _STEP[0] ** 2 + (_STEP[1] * distance) ** 2
    return rotation, translation


def _step_noise(
    state: MotionState, relative: np.ndarray, now: tuple[float, float] | None
) -> tuple[float, float]:
    """Variances of the step: the odometry's own, though never below a share of the usual ones."""
    rotation, translation = step_variance(relative)
    if now is None or state.pose_variance is None:
        return rotation, translation
    own = [after - before for after, before in zip(now, state.pose_variance, strict=True)]
    if not all(math.isfinite(value) and value >= 0 for value in own):
        return rotation, translation
    return max(own[0], _TRUST * rotation), max(own[1], _TRUST * translation)


def _advanced(
    state: MotionState,
    camera_matrix: np.ndarray,
    pose: np.ndarray,
    pose_variance: tuple[float, float] | None,
) -> tuple[MotionState, np.ndarray | None]:
    """The next picture's pose with the noise of the way to it; where a mere turn moves pixels."""
    turn = None
    rotation_variance, translation_variance = 0.0, 0.0
    if state.pose is not None:
        relative = np.linalg.inv(pose) @ state.pose
        rotation_variance, translation_variance = _step_noise(state, relative, pose_variance)
        if state.posed:
            turn = camera_matrix @ relative[:3, :3] @ np.linalg.inv(camera_matrix)
    moved = replace(
        state,
        pose=pose,
        posed=True,
        rotation_variance=state.rotation_variance + rotation_variance,
        translation_variance=state.translation_variance + translation_variance,
        pose_variance=pose_variance,
    )
    return moved, turn


def _pixel(image: np.ndarray, camera_matrix: np.ndarray, options: MotionOptions) -> float:
    """Size of a pixel of the tracking size in normalised coordinates."""
    factor = min(1.0, options.tracks.long_side / max(image.shape[:2]))
    return 2.0 / float((camera_matrix[0, 0] + camera_matrix[1, 1]) * factor)


def _normalised(tracks: Tracks, camera_matrix: np.ndarray) -> Tracks:
    k = camera_matrix
    return replace(tracks, points=(tracks.points - k[:2, 2]) / [k[0, 0], k[1, 1]])


def _views(state: MotionState, present: Tracks, pose: np.ndarray) -> Views:
    """The kept views as the present camera and its tracks see them."""
    relative = [np.linalg.inv(view.pose) @ pose for view in state.views]
    moved = np.array(relative).reshape(-1, 4, 4)
    points = np.full((len(present.ids), len(relative), 2), np.nan)
    for index, view in enumerate(state.views):
        if len(view.tracks.ids):
            place = np.searchsorted(view.tracks.ids, present.ids)
            place = np.minimum(place, len(view.tracks.ids) - 1)
            same = view.tracks.ids[place] == present.ids
            points[same, index] = view.tracks.points[place[same]]
    before = state.views[:-1]  # a view's variances are those of the step that led to it
    rotation = [state.rotation_variance, *(view.rotation_variance for view in before)]
    translation = [state.translation_variance, *(view.translation_variance for view in before)]
    return Views(
        moved[:, :3, :3],
        moved[:, :3, 3],
        points,
        np.array(rotation[: len(relative)]),
        np.array(translation[: len(relative)]),
    )


def _is_view(
    state: MotionState, views: Views, present: Tracks, pixel: float, options: MotionOptions
) -> bool:
    """Whether the picture shows enough that the latest view does not."""
    if not state.views:
        return True
    known = np.isfinite(views.points[:, 0]).all(axis=1)
    if known.sum() < _SHARED * max(len(state.views[0].tracks.ids), 1):
        return True
    rays = np.column_stack([present.points[known], np.ones(int(known.sum()))])
    turned = rays @ views.rotation[0].T
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = turned[:, :2] / turned[:, 2:] - views.points[known, 0]
    return float(np.median(np.linalg.norm(moved, axis=1))) > options.parallax * pixel


def _points(
    views: Views, present: Tracks, tracks: Tracks, pixel: float, options: MotionOptions
) -> MotionPoints:
    """The points of the present picture. `tracks`: the same as `present`, in pixels."""
    seen = np.isfinite(views.points).all(axis=2).sum(axis=1)
    rows = np.flatnonzero(seen >= 2)
    if len(rows) < options.fewest:
        return MotionPoints(tracked=len(tracks.ids))
    only = replace(views, points=views.points[rows])
    found = triangulate(present.points[rows], only, pixel)
    return _usable(found, tracks, rows, pixel, options)


def _usable(
    found: Triangulated, tracks: Tracks, rows: np.ndarray, pixel: float, options: MotionOptions
) -> MotionPoints:
    """The points that can be trusted, their sigmas widened by what the tracks contradict.

    Reprojection errors beyond the tracks' own noise are taken for errors of the rotations: of the
    odometry, its time stamps, the camera's mounting, or the lens.
    """
    rms = float(np.nanmedian(found.rms))
    if rms > options.trusted_rms:
        problem = f"contradicts the pictures: reprojection error {rms:.1f} px"
        return MotionPoints(rms=rms, tracked=len(tracks.ids), problem=problem)
    good = np.isfinite(found.depth) & (found.rms < options.most_rms)
    by_pixels = found.sigma_pixels[good] * max(options.pixel_noise, rms)
    excess = math.sqrt(max(rms**2 - options.pixel_noise**2, 0.0)) * pixel
    by_poses = np.hypot(found.sigma_poses[good], excess * found.sigma_turn[good])
    return MotionPoints(
        tracks.ids[rows][good],
        tracks.points[rows][good].astype(np.float64),
        found.depth[good],
        by_pixels,
        np.hypot(by_pixels, by_poses),
        rms,
        len(tracks.ids),
    )


def log_ratios(points: MotionPoints, depth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """log(triangulated / predicted depth) of each point.

    Args:
        points: N triangulated points.
        depth: H x W predicted depth.
        valid: H x W bool.

    Returns:
        N float64, NaN without a prediction.
    """
    rows, columns = _places(points.pixels, depth.shape)
    predicted = np.where(valid[rows, columns], depth[rows, columns], np.nan).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(points.depth / predicted)
    return np.where(np.isfinite(ratio), ratio, np.nan)


def _places(pixels: np.ndarray, size: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that places (..., x and y) are in."""
    columns = np.clip(np.rint(pixels[..., 0]).astype(int), 0, size[1] - 1)
    rows = np.clip(np.rint(pixels[..., 1]).astype(int), 0, size[0] - 1)
    return rows, columns


def surface_doubt(pixels: np.ndarray, depth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """How uncertain it is which predicted surface a point lies on.

    The prediction blurs and misplaces the edges of things, and most corners that can be tracked lie
    there: compared with the surface behind it, a point on an edge would bend that one forward.

    Args:
        pixels: N x 2, (x, y).
        depth: H x W predicted depth.
        valid: H x W bool.

    Returns:
        N, standard deviations of log depth; 0 where the prediction is flat or missing.
    """
    height, width = depth.shape
    steps = np.linspace(-_AROUND, _AROUND, 5) * max(height, width)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    rows, columns = _places(pixels[:, None] + offsets, depth.shape)
    known = valid[rows, columns] & (depth[rows, columns] > 0)
    logs = np.log(np.where(known, depth[rows, columns], 1.0), dtype=np.float64)
    far = np.where(known, logs, -np.inf).max(axis=1)
    near = np.where(known, logs, np.inf).min(axis=1)
    return np.asarray(_EITHER * np.maximum(far - near, 0.0))


def measure_scale(
    points: MotionPoints, ratios: np.ndarray, size: tuple[int, int], options: MotionOptions
) -> ScaleMeasurement | None:
    """The log scale that most of the picture agrees on.

    Args:
        points: N triangulated points.
        ratios: N, see log_ratios.
        size: (H, W) of the picture.
        options: see MotionOptions.

    Returns:
        None when the points are too few, most of them too uncertain, or disagree.
    """
    known = np.isfinite(ratios)
    good = known & (points.sigma < options.scale_sigma)
    count = int(good.sum())
    if count < max(options.fewest, options.share * int(known.sum())):
        return None
    values, sigma = ratios[good], points.sigma[good]
    weights = point_weights(points.pixels[good], sigma, size)
    centre = weighted_median(values, weights)
    spread = 1.4826 * weighted_median(np.abs(values - centre), weights)
    if spread > options.most_spread:
        return None
    noise = _LEAST_NOISE**2 + float(np.median(sigma)) ** 2 + spread**2 / (count / _NEIGHBOURS)
    return ScaleMeasurement(centre, noise, count, spread)


def point_weights(pixels: np.ndarray, sigma: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """How much each point says about a predicted depth, whose shape is wrong as well.

    Args:
        pixels: N x 2, (x, y) in the picture.
        sigma: N, standard deviations of log depth.
        size: (H, W) of the picture.

    Returns:
        N, positive: 1 / (variance of point and shape), less where points crowd.
    """
    weights = 1 / (sigma**2 + _FLOOR**2)
    weights /= np.sqrt(_crowding(pixels, weights, size))
    return np.asarray(weights)


def _crowding(pixels: np.ndarray, weights: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Of each point: the weight that its cell of the grid holds."""
    rows = np.clip((pixels[:, 1] / size[0] * _CELLS[0]).astype(int), 0, _CELLS[0] - 1)
    columns = np.clip((pixels[:, 0] / size[1] * _CELLS[1]).astype(int), 0, _CELLS[1] - 1)
    cell = rows * _CELLS[1] + columns
    return np.asarray(np.bincount(cell, weights, _CELLS[0] * _CELLS[1])[cell])


def weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """The value with half of the weight below it, of N values and N positive weights."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])
