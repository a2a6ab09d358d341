"""The angle between predicted and true surface normals (paper section 4)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from dyfn_core.losses.target import Target
from dyfn_core.losses.whole_frame import smooth

SMALLEST, LARGEST = math.radians(1), math.radians(90)
SMALLEST_STEP = math.radians(0.1)
HUBER = math.radians(3)
DEGENERATE = 1e-6


def normal_loss(points: Tensor, target: Target, stride: int = 1) -> Tensor:
    """Mean Huber loss of the angles, clamped to 1..90 degrees, over quads of valid neighbours.

    points: B x H x W x 3. Normals are cross products of the differences to the right and lower
    neighbour, which no scale or shift changes. stride: distance of the neighbours in pixels;
    over one pixel the gradient is mostly the prediction's noise, until that is very small.
    """
    ours, theirs = (_normals(p[:, ::stride, ::stride]) for p in (points, target.points))
    known = target.valid[:, ::stride, ::stride]
    valid = known[:, :-1, :-1] & known[:, 1:, :-1] & known[:, :-1, 1:]
    # atan2 keeps a useful gradient at small angles, where acos has none.
    sine = torch.linalg.cross(ours, theirs).square().sum(-1).add(1e-12).sqrt()
    angle = torch.atan2(sine, (ours * theirs).sum(-1)).clamp(SMALLEST, LARGEST)
    loss = F.huber_loss(angle, torch.zeros_like(angle), reduction="none", delta=HUBER) / HUBER
    return (loss * valid).sum() / valid.sum().clamp(min=1)


def _normals(points: Tensor) -> Tensor:
    corner = points[:, :-1, :-1]
    down, right = points[:, 1:, :-1] - corner, points[:, :-1, 1:] - corner
    return F.normalize(torch.linalg.cross(down, right), dim=-1, eps=1e-12)


def corner_normal_loss(points: Tensor, target: Target) -> Tensor:
    """MoGe's normal term: B, from the normals at all four corners of every quad of pixels.

    points: B x H x W x 3. The Huber loss of each angle, clamped to 1..90 degrees, is 0 where one
    of the three points is not valid or the corner is degenerate; their sum over the corners,
    averaged over quads, is divided by 4 max(H, W).
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
    """MoGe's edge term: B, the angles between true and predicted steps to the next pixel.

    points: B x H x W x 3. For training without normals; no part of the paper's objective.
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
    """Angles of vectors ... x 3, radians; atan2 keeps a gradient at small ones."""
    sine = torch.linalg.cross(first, second).norm(dim=-1) + 1e-12
    return torch.atan2(sine, (first * second).sum(-1))


def _corner(points: Tensor, down: int, right: int) -> Tensor:
    """The cross product of the two sides that meet at one corner of every quad."""
    corner = _quad(points, down, right)
    along_column = _quad(points, 1 - down, right) - corner
    along_row = _quad(points, down, 1 - right) - corner
    return torch.linalg.cross(along_column, along_row)


def _quad(values: Tensor, down: int, right: int) -> Tensor:
    height, width = values.shape[1:3]
    return values[:, down : height - 1 + down, right : width - 1 + right]
