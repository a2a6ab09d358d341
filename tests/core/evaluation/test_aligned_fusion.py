"""Depth aligned to the truth and fused with true poses, on a made room, by value."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dyfn_core.data.frames import FrameError
from dyfn_core.evaluation.reconstruction.aligned_fusion import (
    PER_FRAME,
    PER_SEQUENCE,
    AlignedFusion,
    fuse_aligned,
    fusion_table,
)
from dyfn_core.models.base import AffinePoints, Latent
from tests.support.made_room import RoomSequence, room_frame
from tests.support.pinhole import PinholeModel

FRAMES = 6
BASE = "base model"


class TrueModel(PinholeModel):
    """Predicts the room's depth times a factor per frame."""

    def __init__(self, factors: np.ndarray) -> None:
        super().__init__()
        self.factors = iter(factors)
        self.places = iter(range(len(factors)))

    def decode(self, latent: Latent) -> AffinePoints:
        frame = room_frame(next(self.places))
        height, width = frame.depth.shape
        fx, fy, cx, cy = frame.intrinsics
        v, u = np.mgrid[:height, :width] + 0.5
        depth = frame.depth * next(self.factors)
        points = np.stack(
            [(u / width - cx) / fx * depth, (v / height - cy) / fy * depth, depth], -1
        )
        mask = torch.ones(1, height, width)
        return AffinePoints(torch.from_numpy(points)[None].float(), mask)


def fused(factors: np.ndarray) -> AlignedFusion:
    model = TrueModel(factors).eval()
    return fuse_aligned(RoomSequence(len(factors)), range(len(factors)), model)


def test_one_scale_for_all_frames_costs_nothing() -> None:
    values = fused(np.full(FRAMES, 0.3)).values(0.05)[BASE]
    for alignment in (PER_FRAME, PER_SEQUENCE):
        found = values[alignment]
        assert found["depth"]["abs_rel"] < 1e-3 and found["depth"]["delta1"] > 0.999
        assert found["cloud"]["chamfer"] < 0.01 and found["cloud"]["precision"] > 0.99


def test_a_scale_that_wanders_ruins_the_sequence_and_not_the_frames() -> None:
    found = fused(np.exp(0.3 * np.sin(2.0 * np.arange(FRAMES))))
    values = found.values(0.05)[BASE]
    assert values[PER_FRAME]["depth"]["abs_rel"] < 1e-3
    assert values[PER_FRAME]["cloud"]["chamfer"] < 0.01
    assert values[PER_SEQUENCE]["depth"]["abs_rel"] > 0.05
    assert values[PER_SEQUENCE]["cloud"]["chamfer"] > 0.1
    table = fusion_table(found.values(0.05))
    assert [row[:2] for row in table.rows] == [[BASE, PER_FRAME], [BASE, PER_SEQUENCE]]
    assert all(len(row) == len(table.header) for row in table.rows)


def test_without_a_pose_there_is_nothing_to_fuse() -> None:
    class Unposed(RoomSequence):
        def read(self, index: int):  # type: ignore[no-untyped-def]
            if index == 0:
                raise FrameError("x.png: not a picture")
            frame = room_frame(index)
            return type(frame)(frame.image, frame.depth, frame.intrinsics, None)

    with pytest.raises(ValueError, match=r"room: no frame with a true pose: .*x\.png"):
        fuse_aligned(Unposed(3), range(3), TrueModel(np.ones(3)).eval())
