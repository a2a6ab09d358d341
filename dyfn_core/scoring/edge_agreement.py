"""Whether the edges of depth lie where those of the picture do, over many frames."""

from __future__ import annotations

import cv2
import numpy as np

SIZE = (72, 96)  # rows and columns that frames are reduced to
JUMP = 0.05  # a step of log depth that counts as an edge
MIN_EDGE_PIXELS = 20  # of such edges, for a frame to say anything
SLACK = 1  # pixels of SIZE that truth may be off
APART = 10  # displacements by a tenth of the size and more have nothing to do with the truth
MOST_STEP = 0.3  # of log depth: larger steps count no more


class EdgeAgreement:
    """Compares pictures and depth by their edges, in memory that does not grow.

    The directions of edges (as double angles, weighted by strength) of picture and depth are
    correlated over all displacements of one against the other. Where they belong together, the
    correlation without displacement stands out of the others.
    """

    def __init__(self) -> None:
        """No frames yet."""
        self.frames = 0
        self._total = np.zeros(SIZE)

    def push(self, image: np.ndarray, depth: np.ndarray) -> None:
        """One frame; one whose depth has no edges says nothing.

        Args:
            image: H x W x 3 uint8 RGB.
            depth: H' x W' metres of the same view, NaN invalid.
        """
        grey = cv2.resize(
            cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), SIZE[::-1], interpolation=cv2.INTER_AREA
        )
        small = cv2.resize(depth.astype(np.float32), SIZE[::-1], interpolation=cv2.INTER_NEAREST)
        known = np.isfinite(small) & (small > 0)
        x, y, valid = _gradient(np.log(np.where(known, small, 1.0)), known)
        strength = np.minimum(np.hypot(x, y), MOST_STEP)
        if np.count_nonzero(valid & (strength > JUMP)) < MIN_EDGE_PIXELS:
            return
        self.frames += 1
        u, v, inside = _gradient(grey.astype(np.float32), np.ones(SIZE, bool))
        seen = _directions(u, v, np.sqrt(np.hypot(u, v)), inside)
        true = _directions(x, y, strength, valid)
        spectra = zip(seen, true, strict=True)
        self._total += sum(
            np.fft.irfft2(np.conj(np.fft.rfft2(a)) * np.fft.rfft2(b), s=SIZE) for a, b in spectra
        )

    def agreement(self) -> float:
        """The correlation at the right place over the largest at displaced ones.

        Well above 1 where picture and depth belong together; at most 0 when no frame could be
        compared, as without edges in any picture.
        """
        rows, columns = (np.minimum(np.arange(n), n - np.arange(n)) for n in SIZE)
        near = (rows[:, None] <= SLACK) & (columns <= SLACK)
        apart = (rows[:, None] >= SIZE[0] // APART) | (columns >= SIZE[1] // APART)
        above = self._total - self._total[apart].mean()
        largest = float(above[apart].max())
        return float(above[near].max()) / largest if largest > 0 else 0.0


def _gradient(values: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Differences to the right and down, and where both are known."""
    x, y, valid = np.zeros(SIZE), np.zeros(SIZE), np.zeros(SIZE, bool)
    x[:, :-1], y[:-1] = np.diff(values, axis=1), np.diff(values, axis=0)
    valid[:-1, :-1] = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1]
    return np.where(valid, x, 0), np.where(valid, y, 0), valid


def _directions(
    x: np.ndarray, y: np.ndarray, strength: np.ndarray, valid: np.ndarray
) -> list[np.ndarray]:
    """cos and sin of twice the angle times strength, mean 0 over the valid, norm 1."""
    double = 2 * np.arctan2(y, x)
    found = []
    for part in (strength * np.cos(double), strength * np.sin(double)):
        centred = np.where(valid, part - part[valid].mean(), 0.0)
        norm = float(np.linalg.norm(centred))
        found.append(centred / norm if norm > 1e-6 else np.zeros(SIZE))
    return found
