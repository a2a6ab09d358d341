"""What lets the small model draw edges: the gradient term, and residual blocks that stay alive."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyfn_core.losses.gradient import gradient_loss
from dyfn_core.losses.target import Target, target_from_depth
from dyfn_core.models.mini import MiniResidualBlock
from tests.support.seeded import normal, uniform


def step_scene(near: float = 1.0, far: float = 3.0) -> Target:
    """16 x 16: the left half near, the right half far, one row of sky and one of nothing."""
    depth = torch.full((1, 16, 16), far)
    depth[:, :, :8] = near
    depth[:, 0], depth[:, 1] = math.inf, math.nan
    return target_from_depth(depth, torch.tensor([[0.8, 0.8, 0.5, 0.5]]), 1.0)


def test_gradient_term_is_zero_at_the_truth_under_any_scale() -> None:
    target = step_scene()
    assert float(gradient_loss(target.points, target)) < 1e-6
    assert float(gradient_loss(4.2 * target.points, target)) < 1e-6


def test_gradient_term_counts_a_missed_edge_once_a_row_and_scale() -> None:
    """A flat prediction errs by log 3 in one of the pairs of every row; columns are right."""
    target = step_scene()
    flat = torch.ones_like(target.points)
    pairs = [15, 7, 3, 1]  # in a row of 16, 8, 4 and 2 samples
    expected = sum(math.log(3.0) / count for count in pairs)
    assert math.isclose(float(gradient_loss(flat, target)), expected, rel_tol=1e-5)


def test_gradient_term_of_nothing_valid_is_zero_with_zero_gradient() -> None:
    target = target_from_depth(
        torch.full((2, 8, 8), math.nan), torch.tensor([[0.8, 0.8, 0.5, 0.5]] * 2), 1.0
    )
    points = uniform(0, 2, 8, 8, 3).add(0.5).requires_grad_()
    loss = gradient_loss(points, target)
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert points.grad is not None and not points.grad.any()


def _alive(block: MiniResidualBlock, x: Tensor) -> float:
    """Share of the inner activations' inputs that are positive."""
    seen: list[Tensor] = []
    handle = block.norm_second.register_forward_hook(lambda _m, _i, out: seen.append(out))
    block(x)
    handle.remove()
    return float((seen[0] > 0).float().mean())


def test_residual_block_sees_detail_beside_channels_at_other_levels() -> None:
    """One channel a hundred deviations away must not drown the detail of the others."""
    torch.manual_seed(0)
    block = MiniResidualBlock(64)
    detail = normal(0, 2, 64, 12, 16)
    level = torch.zeros(1, 64, 1, 1)
    level[:, 0], level[:, 33] = 100.0, -100.0
    inner = block(detail + level) - (detail + level)
    alone = block(detail) - detail
    torch.testing.assert_close(inner, alone, rtol=1e-3, atol=1e-4)
    assert 0.3 < _alive(block, detail + level) < 0.7


def test_every_weight_of_a_residual_block_has_a_gradient() -> None:
    torch.manual_seed(0)
    block = MiniResidualBlock(16)
    x = normal(0, 2, 16, 8, 8) + 50 * normal(1, 1, 16, 1, 1)
    (block(x) * normal(2, 2, 16, 8, 8)).sum().backward()
    for name, parameter in block.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 1e-4, name
