"""A coloured point cloud of bounded size: the mean point of every occupied voxel."""

from __future__ import annotations

import numpy as np

_BITS = 21  # of each axis in a key
_HALF = 1 << (_BITS - 1)
_MASK = (1 << _BITS) - 1
_PENDING = 500_000  # points that wait for being merged together


class VoxelGrid:
    """Fuses points as they come; memory depends on max_voxels, not on the number of points.

    size: edge of a voxel in the unit of the points; it doubles as often as is needed to stay
    under max_voxels. Deterministic.
    """

    def __init__(self, size: float, max_voxels: int = 2_000_000) -> None:
        if not size > 0 or max_voxels < 1:
            raise ValueError(f"voxels of {size} and at most {max_voxels} of them: must be positive")
        self.size = float(size)
        self.max_voxels = max_voxels
        self.outside = 0
        self._keys = np.empty(0, np.int64)
        self._sums = np.empty((0, 7))  # x y z r g b count
        self._pending: list[np.ndarray] = []
        self._waiting = 0

    def add(self, points: np.ndarray, colours: np.ndarray) -> None:
        """points: N x 3, finite; those more than a million voxels away are counted in `outside`.

        colours: N x 3 uint8 RGB.
        """
        rows = np.empty((len(points), 7))
        rows[:, :3], rows[:, 3:6], rows[:, 6] = points, colours, 1
        self._pending.append(rows)
        self._waiting += len(rows)
        if self._waiting >= _PENDING:
            self._merge()

    def cloud(self) -> tuple[np.ndarray, np.ndarray]:
        """N x 3 float32 mean points and N x 3 uint8 mean colours, a voxel each."""
        self._merge()
        means = self._sums[:, :6] / self._sums[:, 6:]
        return means[:, :3].astype(np.float32), np.rint(means[:, 3:]).astype(np.uint8)

    def _merge(self) -> None:
        if not self._pending:
            return
        rows = np.concatenate(self._pending)
        self._pending, self._waiting = [], 0
        cells = np.floor(rows[:, :3] / self.size)
        inside = (np.abs(cells) < _HALF - 1).all(axis=1)
        self.outside += int((~inside).sum())
        keys = _encode(cells[inside].astype(np.int64) + _HALF)
        self._sum(np.concatenate([self._keys, keys]), np.concatenate([self._sums, rows[inside]]))
        while len(self._keys) > self.max_voxels:
            self.size *= 2
            # Halving a shifted cell leaves it shifted by half of _HALF.
            self._sum(_encode((_decode(self._keys) >> 1) + _HALF // 2), self._sums)

    def _sum(self, keys: np.ndarray, rows: np.ndarray) -> None:
        self._keys, place = np.unique(keys, return_inverse=True)
        columns = [np.bincount(place, column, len(self._keys)) for column in rows.T]
        self._sums = np.stack(columns, axis=1)


def _encode(cells: np.ndarray) -> np.ndarray:
    """N x 3 cells, 0 .. 2 ** _BITS - 1 -> N keys."""
    result: np.ndarray = (cells[:, 0] << 2 * _BITS) | (cells[:, 1] << _BITS) | cells[:, 2]
    return result


def _decode(keys: np.ndarray) -> np.ndarray:
    return np.stack([keys >> 2 * _BITS, (keys >> _BITS) & _MASK, keys & _MASK], axis=1)
