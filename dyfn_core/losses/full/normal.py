"""L_normal: the angle between predicted and true surface normals (paper section 4)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyfn_core.losses.full.whole_frame import smooth
from dyfn_core.losses.target import Target

SMALLEST, LARGEST = math.radians(1), math.radians(90)
SMALLEST_STEP = math.radians(0.1)
HUBER = math.radians(3)
DEGENERATE = 1e-6


def normal_loss(points: Tensor, target: Target) -> Tensor:
    """L_normal = mean_i sum_c huber(angle(n_ic, n*_ic)) / (4 max(H, W)) (paper section 4; MoGe).

    c runs over the four corners of the quad of pixels i, whose normals are cross products of its
    two sides there; no scale or shift changes them. Angles are clamped to 1..90 degrees, the Huber
    loss is linear above 3 degrees. A corner counts 0 where one of its three points is not valid or
    where it is degenerate.

    Args:
        points: Predicted points, B x H x W x 3.
        target: The true geometry of the frames.

    Returns:
        The loss of each frame, B.
    """
    height, width = points.shape[1:3]
    total = points.new_zeros(len(points), height - 1, width - 1)
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        ours, theirs = (_corner(p, down, right) for p in (points, target.points))
        valid = (
            _quad(target.valid, down, right)
            & _quad(target.valid, 1 - down, right)
            & _quad(target.valid, down, 1 - right)
            & (ours.norm(dim=-1) > DEGENERATE)
            & (theirs.norm(dim=-1) > DEGENERATE)
        )
        angle = angle_between(ours, theirs).clamp(SMALLEST, LARGEST)
        total = total + valid * smooth(angle, HUBER)
    return total.mean((-2, -1)) / (4 * max(height, width))


def edge_loss(points: Tensor, target: Target) -> Tensor:
    """MoGe's edge term: the angles between true and predicted steps to the next pixel.

    For training without normals; no part of the paper's objective.

    Args:
        points: Predicted points, B x H x W x 3.
        target: The true geometry of the frames.

    Returns:
        The loss of each frame, B.
    """
    height, width = points.shape[1:3]
    total = points.new_zeros(len(points))
    for axis in (1, 2):
        ours, theirs = points.diff(dim=axis), target.points.diff(dim=axis)
        length = target.valid.shape[axis]
        valid = target.valid.narrow(axis, 0, length - 1) & target.valid.narrow(axis, 1, length - 1)
        angle = angle_between(ours, theirs).clamp(SMALLEST_STEP, LARGEST)
        total = total + (valid * smooth(angle, HUBER)).mean((-2, -1))
    return total / (2 * max(height, width))


def angle_between(first: Tensor, second: Tensor) -> Tensor:
    """Measure angles with atan2, which keeps a gradient at small ones.

    Args:
        first: Vectors, ... x 3.
        second: The others, ... x 3.

    Returns:
        Angles, radians.
    """
    sine = torch.linalg.cross(first, second).norm(dim=-1) + 1e-12
    return torch.atan2(sine, (first * second).sum(-1))


def _corner(points: Tensor, down: int, right: int) -> Tensor:
    """The cross product of the two sides that meet at one corner of every quad."""
    corner = _quad(points, down, right)
    along_column = _quad(points, 1 - down, right) - corner
    along_row = _quad(points, down, 1 - right) - corner
    normals: Tensor = torch.linalg.cross(along_column, along_row)
    return normals


def _quad(values: Tensor, down: int, right: int) -> Tensor:
    height, width = values.shape[1:3]
    return values[:, down : height - 1 + down, right : width - 1 + right]
