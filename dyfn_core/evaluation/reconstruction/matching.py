"""Dense or sparse matches between two images of one scene, without learned weights."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import cv2
import numpy as np

RATIO = 0.8  # best descriptor distance over the second best
MAX_DISAGREEMENT = 1.0  # pixels between a start and where forward and backward flow lead back
FEATURES = 4000


@dataclass(frozen=True)
class Matches:
    """Pixels of the same points. first, second: N x 2 float64 (x, y), a pixel's centre integral."""

    first: np.ndarray
    second: np.ndarray

    def __len__(self) -> int:
        return len(self.first)


class Matcher(Protocol):
    """Anything that finds matches. What `describe` returns is only ever given to `match`."""

    def describe(self, image: np.ndarray) -> Any:
        """H x W x 3 uint8 RGB -> what matching needs to know of it, computed once an image."""

    def match(self, first: Any, second: Any) -> Matches:
        """Matches from one described image to another; empty when there are none."""


@dataclass(frozen=True)
class FlowMatcher:
    """DIS optical flow both ways; kept where going there and back ends within a pixel.

    samples: number of starts, about, on a regular grid.
    """

    samples: int = 1500

    def describe(self, image: np.ndarray) -> np.ndarray:
        """The grey image."""
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)

    def match(self, first: np.ndarray, second: np.ndarray) -> Matches:
        """See Matcher. Raises ValueError for images of differing sizes."""
        if first.shape != second.shape:
            raise ValueError(f"flow needs images of one size, got {first.shape}, {second.shape}")
        flow = _opencv("DISOpticalFlow_create")(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        forward = flow.calc(first, second, None)
        backward = flow.calc(second, first, None)
        height, width = first.shape
        step = max(1, round((height * width / self.samples) ** 0.5))
        y, x = (g.ravel() for g in np.mgrid[step // 2 : height : step, step // 2 : width : step])
        start = np.stack([x, y], -1).astype(np.float32)
        end = start + forward[y, x]
        inside = ((end >= 0) & (end <= [width - 1, height - 1])).all(1)
        start, end = start[inside], end[inside]
        back = end + sample_at(backward, end.astype(np.float64))
        kept = np.linalg.norm(back - start, axis=1) < MAX_DISAGREEMENT
        return Matches(start[kept].astype(np.float64), end[kept].astype(np.float64))


@dataclass(frozen=True)
class FeatureMatcher:
    """Key points whose descriptors are each other's best by the ratio test.

    make: an OpenCV Feature2D. norm: cv2.NORM_L2 or cv2.NORM_HAMMING, as its descriptors need.
    """

    make: Callable[[], Any]
    norm: int

    def describe(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Positions N x 2, and descriptors (None when there are none)."""
        found, descriptors = self.make().detectAndCompute(
            cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None
        )
        return np.array([point.pt for point in found], np.float64).reshape(-1, 2), descriptors

    def match(
        self,
        first: tuple[np.ndarray, np.ndarray | None],
        second: tuple[np.ndarray, np.ndarray | None],
    ) -> Matches:
        """See Matcher."""
        (here, a), (there, b) = first, second
        if a is None or b is None or len(a) < 2 or len(b) < 2:
            return Matches(np.zeros((0, 2)), np.zeros((0, 2)))
        matcher = cv2.BFMatcher(self.norm)
        forward, backward = _distinct(matcher, a, b), _distinct(matcher, b, a)
        pairs = sorted((i, j) for i, j in forward.items() if backward.get(j) == i)
        rows = np.array(pairs, int).reshape(-1, 2)
        return Matches(here[rows[:, 0]], there[rows[:, 1]])


def _distinct(matcher: Any, a: np.ndarray, b: np.ndarray) -> dict[int, int]:
    """Row of a -> its best row of b, where the second best is clearly worse."""
    return {
        best.queryIdx: best.trainIdx
        for best, other in matcher.knnMatch(a, b, k=2)
        if best.distance < RATIO * other.distance
    }


@dataclass(frozen=True)
class JoinedMatcher:
    """The matches of several matchers together: flow for small motion, features for large."""

    matchers: tuple[Matcher, ...]

    def describe(self, image: np.ndarray) -> tuple[Any, ...]:
        """What each of them needs."""
        return tuple(matcher.describe(image) for matcher in self.matchers)

    def match(self, first: tuple[Any, ...], second: tuple[Any, ...]) -> Matches:
        """See Matcher."""
        found = [
            matcher.match(a, b) for matcher, a, b in zip(self.matchers, first, second, strict=True)
        ]
        return Matches(
            np.concatenate([matches.first for matches in found]),
            np.concatenate([matches.second for matches in found]),
        )


def _opencv(name: str) -> Callable[..., Any]:
    """A maker that not every build of OpenCV has: version 5 has AKAZE in contrib alone."""
    for module in (cv2, getattr(cv2, "xfeatures2d", None)):
        make: Callable[..., Any] | None = getattr(module, name, None)
        if make is not None:
            return make
    raise ValueError(
        f"this build of OpenCV ({cv2.__version__}) has no {name}: take another matcher"
    )


MATCHERS: dict[str, Callable[[], Matcher]] = {
    "dis": FlowMatcher,
    "sift": lambda: FeatureMatcher(lambda: _opencv("SIFT_create")(FEATURES), cv2.NORM_L2),
    "akaze": lambda: FeatureMatcher(_opencv("AKAZE_create"), cv2.NORM_HAMMING),
    "orb": lambda: FeatureMatcher(lambda: _opencv("ORB_create")(FEATURES), cv2.NORM_HAMMING),
}


def build_matcher(name: str) -> Matcher:
    """A matcher of MATCHERS, or several joined by "+", as "dis+sift".

    Raises ValueError for another name, or for what this build of OpenCV lacks.
    """
    names = name.split("+")
    unknown = [part for part in names if part not in MATCHERS]
    if unknown:
        known = ", ".join(MATCHERS)
        raise ValueError(f"matcher {unknown[0]!r} is unknown, expected {known}, or some with +")
    built = tuple(MATCHERS[part]() for part in names)
    return built[0] if len(built) == 1 else JoinedMatcher(built)


def sample_at(values: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """H x W x C float32 at N x 2 pixels: N x C float64.

    Bilinear; the nearest pixel's where one of the four is NaN; NaN outside the image.
    """
    height, width = values.shape[:2]
    x, y = pixels[:, 0], pixels[:, 1]
    inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    left = np.clip(np.floor(x), 0, max(width - 2, 0)).astype(int)
    top = np.clip(np.floor(y), 0, max(height - 2, 0)).astype(int)
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    a, b = np.clip(x - left, 0, 1)[:, None], np.clip(y - top, 0, 1)[:, None]
    mixed = (values[top, left] * (1 - a) + values[top, right] * a) * (1 - b) + (
        values[below, left] * (1 - a) + values[below, right] * a
    ) * b
    near = values[np.where(b[:, 0] < 0.5, top, below), np.where(a[:, 0] < 0.5, left, right)]
    known = np.isfinite(mixed).all(1, keepdims=True)
    found: np.ndarray = np.where(known, mixed, near).astype(np.float64)
    found[~inside] = np.nan
    return found


@dataclass
class MatchWindow:
    """Matches of the newest frame to earlier ones; several reconstructions may share them.

    reach: how many frames back can be asked for; older ones are forgotten.
    """

    matcher: Matcher
    reach: int
    _described: deque[Any] = field(init=False)
    _found: dict[int, Matches] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self._described = deque(maxlen=self.reach + 1)

    def push(self, image: np.ndarray) -> None:
        """The next frame, H x W x 3 uint8 RGB."""
        self._described.append(self.matcher.describe(image))
        self._found = {}

    def back(self, offset: int) -> Matches:
        """From the newest frame to the one `offset` before. Raises IndexError beyond reach."""
        if not 0 < offset < len(self._described):
            raise IndexError(f"no frame {offset} back, only {len(self._described) - 1}")
        if offset not in self._found:
            newest, earlier = self._described[-1], self._described[-1 - offset]
            self._found[offset] = self.matcher.match(newest, earlier)
        return self._found[offset]


def partners(offsets: Sequence[int], posed: Sequence[bool]) -> list[int]:
    """Which frames back to use, given for each earlier frame (newest last) whether it has a pose.

    Those of `offsets` that have a pose; when none has, the newest that has, if any.
    """
    known = [offset for offset, has in enumerate(reversed(posed), 1) if has]
    return [offset for offset in offsets if offset in known] or known[:1]
