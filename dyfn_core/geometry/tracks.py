"""Points followed from picture to picture by pyramidal Lucas-Kanade."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

_WINDOW = (15, 15)  # pixels of a patch, at the tracking size
_LEVELS = 3
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.03)
_QUALITY = 0.005  # of a corner, as a share of the best one's
_BORDER = 2.0  # pixels from the edge of the picture within which a track ends


@dataclass(frozen=True)
class TrackOptions:
    """How points are followed.

    Attributes:
        long_side: pixels of the longer side that pictures are shrunk to before tracking (the
            tracking size).
        most: tracks that are kept at once.
        spacing: least distance of two corners, in pixels of the tracking size.
        forward_backward: a track ends when tracking it back misses its origin by more, in pixels
            of the tracking size.
    """

    long_side: int = 320
    most: int = 700
    spacing: float = 5.0
    forward_backward: float = 0.7


@dataclass(frozen=True)
class Tracks:
    """The tracks that reach one picture.

    Attributes:
        ids: N int64, rising; a track keeps its number over its whole life.
        points: N x 2 float32, pixels (x, y) of the picture as it came; the centre of its first
            pixel is (0, 0).
    """

    ids: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))
    points: np.ndarray = field(default_factory=lambda: np.empty((0, 2), np.float32))


@dataclass(frozen=True)
class TrackerState:
    """What a tracker remembers between two pictures; a value.

    Attributes:
        grey: h x w uint8, the last picture at the tracking size.
        tracks: of that picture.
        next_id: number of the next new track.
    """

    grey: np.ndarray
    tracks: Tracks
    next_id: int


def track(
    state: TrackerState | None,
    image: np.ndarray,
    options: TrackOptions,
    rotation: np.ndarray | None = None,
    visible: np.ndarray | None = None,
) -> TrackerState:
    """Follow the tracks into the next picture, and begin new ones where there are few.

    A picture of another size ends all tracks.

    Args:
        state: after the picture before; None for the first picture.
        image: H x W x 3 uint8 RGB.
        options: see TrackOptions.
        rotation: 3 x 3 homography in pixels of the picture, K R K^-1: where the points would be
            had the camera only turned. It gives the first guess. None: the points' old places.
        visible: H x W bool, where the image shows something; new tracks keep away from the rest.
            None: everywhere.

    Returns:
        The state after this picture; its `tracks` are the picture's.
    """
    grey, scale = _shrunk(image, options.long_side)
    ids, points, next_id = np.empty(0, np.int64), np.empty((0, 2), np.float32), 0
    if state is not None:
        next_id = state.next_id
        if state.grey.shape == grey.shape:
            ids, points = _followed(state, grey, scale, options, rotation)
    fresh = _corners(grey, points, options, visible)
    ids = np.concatenate([ids, np.arange(len(fresh), dtype=np.int64) + next_id])
    points = np.concatenate([points, fresh])
    tracks = Tracks(ids, ((points + 0.5) * scale - 0.5).astype(np.float32))
    return TrackerState(grey, tracks, next_id + len(fresh))


def _shrunk(image: np.ndarray, long_side: int) -> tuple[np.ndarray, np.ndarray]:
    """Grey at the tracking size, and pixels of the picture per pixel of it, (x, y)."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    factor = min(1.0, long_side / max(height, width))
    size = (max(round(width * factor), 1), max(round(height * factor), 1))
    if factor < 1:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return grey, np.array([width / size[0], height / size[1]])


def _followed(
    state: TrackerState,
    grey: np.ndarray,
    scale: np.ndarray,
    options: TrackOptions,
    rotation: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Ids (N) and points (N x 2, tracking size) of the tracks that reach the next picture."""
    if not len(state.tracks.ids):
        return state.tracks.ids, np.empty((0, 2), np.float32)
    before = ((state.tracks.points + 0.5) / scale - 0.5).astype(np.float32)
    guess = before if rotation is None else _turned(state.tracks.points, rotation, scale)
    after, found = _flow(state.grey, grey, before, guess)
    back, returned = _flow(grey, state.grey, after, before, levels=1)  # the guess is near
    good = found & returned & _inside(after, grey, _BORDER)
    good &= np.linalg.norm(back - before, axis=1) < options.forward_backward
    return state.tracks.ids[good], after[good]


def _flow(
    first: np.ndarray,
    second: np.ndarray,
    points: np.ndarray,
    guess: np.ndarray,
    levels: int = _LEVELS,
) -> tuple[np.ndarray, np.ndarray]:
    """Places in the second picture (N x 2) of points of the first one, and which were found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        points,
        guess.copy(),  # it is written to
        winSize=_WINDOW,
        maxLevel=levels,
        criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return there, found.ravel() > 0


def _turned(points: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Pixels of the picture before -> the guess at the tracking size."""
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        there = homogeneous[:, :2] / homogeneous[:, 2:]
    behind = (homogeneous[:, 2] <= 0) | ~np.isfinite(there).all(axis=1)
    there[behind] = points[behind]
    return np.asarray((there + 0.5) / scale - 0.5, np.float32)


def _corners(
    grey: np.ndarray, points: np.ndarray, options: TrackOptions, visible: np.ndarray | None
) -> np.ndarray:
    """New corners away from the points there are, N x 2 float32 at the tracking size."""
    room = options.most - len(points)
    if room <= 0:
        return np.empty((0, 2), np.float32)
    mask = _free(grey, points, options.spacing)
    if visible is not None:
        mask[_blind(visible, grey)] = 0
    found = cv2.goodFeaturesToTrack(grey, room, _QUALITY, options.spacing, mask=mask)
    if found is None:
        return np.empty((0, 2), np.float32)
    corners = np.asarray(found, np.float32).reshape(-1, 2)
    return np.asarray(corners[_inside(corners, grey, _BORDER + 1)])


def _free(grey: np.ndarray, points: np.ndarray, spacing: float) -> np.ndarray:
    """255 farther than `spacing` from all points, else 0."""
    mask = np.full(grey.shape, 255, np.uint8)
    columns, rows = np.rint(points).astype(int).T
    mask[rows, columns] = 0
    side = 2 * round(spacing) + 1
    return np.asarray(cv2.erode(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))))


def _blind(visible: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """h x w bool at the tracking size: within a patch of what the image does not show."""
    size = (grey.shape[1], grey.shape[0])
    nothing = cv2.resize((~visible).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.dilate(nothing, np.ones(_WINDOW, np.uint8)) > 0)


def _inside(points: np.ndarray, grey: np.ndarray, border: float) -> np.ndarray:
    """Which points are farther than `border` from the edges of the picture."""
    height, width = grey.shape
    last = np.array([width - 1 - border, height - 1 - border])
    return np.asarray(((points >= border) & (points < last)).all(axis=1))
