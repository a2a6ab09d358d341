"""The terms of the objective: what they ignore, what they see, and that gradients reach them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from dyfn_core.losses.canonical_scale import HUBER, canonical_scale_loss
from dyfn_core.losses.clip_alignment import clip_alignment_loss
from dyfn_core.losses.full import local as full_local
from dyfn_core.losses.full import temporal as full_temporal
from dyfn_core.losses.motion import pair_motion_loss, window_pairs
from dyfn_core.losses.sampled.clip_alignment import align_clips
from dyfn_core.losses.sampled.local import local_loss
from dyfn_core.losses.sampled.mask import mask_loss
from dyfn_core.losses.sampled.normal import normal_loss
from dyfn_core.losses.sampled.temporal import temporal_loss
from dyfn_core.losses.sampled.whole_frame import align_frames, global_loss
from dyfn_core.losses.scale_spread import scale_spread_loss
from dyfn_core.losses.target import ClipTarget, Target, target_from_depth
from tests.support.seeded import normal, uniform

INTRINSICS = torch.tensor([0.8, 1.0667, 0.5, 0.5])
ASPECT = 4 / 3


def scene(frames: int = 2, seed: int = 0, size: tuple[int, int] = (24, 32)) -> Target:
    """Smooth depth of 1 to 6 m, with a strip of sky and a strip of nothing."""
    torch.manual_seed(seed)
    coarse = 1 + 5 * uniform(seed, frames, 1, 4, 4)
    depth = torch.nn.functional.interpolate(coarse, size=size, mode="bicubic")[:, 0].clamp(0.5)
    depth[:, :3] = math.inf
    depth[:, -2:] = math.nan
    return target_from_depth(depth, INTRINSICS.expand(frames, -1), ASPECT)


def affine(points: Tensor, scale: float, shift: float) -> Tensor:
    """Points that `scale` and a z-shift of `shift` bring back to `points`."""
    return (points - torch.tensor([0.0, 0.0, shift])) / scale


def whole_frames(points: Tensor, target: Target) -> Tensor:
    """The global loss under each frame's own alignment."""
    return global_loss(points, target, *align_frames(points, target))


def test_target_projects_back_onto_its_pixels() -> None:
    target = scene(1)
    points = target.points[0, 10, 7]
    u = 0.8 * points[0] / points[2] + 0.5
    v = 1.0667 * points[1] / points[2] + 0.5
    torch.testing.assert_close(torch.stack([u, v]), torch.tensor([7.5 / 32, 10.5 / 24]))
    assert bool(target.infinite[0, 0, 0])
    assert not bool(target.valid[0, 0, 0])
    assert not bool(target.valid[0, -1, 0] | target.infinite[0, -1, 0])
    focal_pixels = 0.8 * 32
    torch.testing.assert_close(target.focal[0], torch.tensor(focal_pixels / 40), rtol=1e-3, atol=0)


def test_frame_loss_ignores_scale_and_shift_of_each_frame() -> None:
    target = scene()
    exact = torch.stack([affine(target.points[0], 2, 0.5), affine(target.points[1], 0.1, -1)])
    scale, _ = align_frames(exact, target)
    torch.testing.assert_close(scale, torch.tensor([2.0, 0.1]))
    assert float(whole_frames(exact, target)) < 1e-5
    assert float(whole_frames(exact + 0.2 * uniform(7, *exact.shape), target)) > 0.02


def test_frame_loss_of_a_known_error_is_that_error_over_depth() -> None:
    """One wrong pixel among many: the alignment stays, the loss is its |error| / z / count."""
    target = scene(1)
    wrong = target.points.clone()
    wrong[0, 12, 12, 0] += 0.3
    loss = whole_frames(wrong, target)
    expected = 0.3 / target.points[0, 12, 12, 2] / target.valid.sum()
    torch.testing.assert_close(loss, expected, rtol=1e-3, atol=0)


def test_frame_upside_down_or_empty_counts_nothing_and_breaks_nothing() -> None:
    target = scene(2)
    nothing = Target(target.points, torch.zeros_like(target.valid), target.infinite, target.focal)
    points = target.points.clone().requires_grad_()
    loss = whole_frames(points, nothing)
    loss = loss + local_loss(points, nothing, torch.ones(2), 0.25, 4)
    loss = loss + normal_loss(points, nothing) + mask_loss(points[..., 0], nothing) * 0
    loss.backward()
    assert float(loss.detach()) == 0
    assert points.grad is not None
    assert bool(torch.isfinite(points.grad).all())


def test_local_loss_ignores_what_happens_between_the_balls() -> None:
    """Left and right half at other scales: right locally, wrong as a whole frame."""
    target = scene(1, size=(48, 64))
    torn = target.points.clone()
    torn[:, :, 32:] = affine(torn[:, :, 32:], 2.0, 0.3)
    torch.manual_seed(0)
    local = local_loss(torn, target, torch.ones(1), 1 / 4, 64)
    assert float(local) < 0.5 * float(whole_frames(torn, target))
    torch.manual_seed(0)
    assert float(local_loss(target.points, target, torch.ones(1), 1 / 4, 64)) < 1e-5


def test_balls_of_the_finest_level_by_plain_loops() -> None:
    """An affine copy of the truth with a few outliers: the best fit of every ball is known."""
    level, scale, shift = full_local.LocalLevel(1 / 32, 6, 4), 2.0, torch.tensor([0.1, -0.2, 0.3])
    target = scene(1, size=(240, 320))
    truth = target.points[0].double().numpy()
    predicted = (target.points - shift) / scale
    error = torch.zeros_like(predicted)
    error[:, ::5, ::7, 2] = 0.04
    anchors = [row * 320 + column for row in (62, 101, 153) for column in (81, 200)]
    assert all(row % 5 or column % 7 for row, column in (divmod(a, 320) for a in anchors))
    reach = math.ceil(0.5 / 32 * math.hypot(240, 320))
    typical = 1 / np.mean([1 / z for z in truth[target.valid[0].numpy()][:, 2]])
    wanted, held = 0.0, []
    for row, column in (divmod(anchor, 320) for anchor in anchors):
        radius = 0.5 / 32 * truth[row, column, 2] / float(target.focal[0])
        inside = [
            (i, j)
            for i in range(row - reach, row + reach + 1)
            for j in range(column - reach, column + reach + 1)
            if np.linalg.norm(truth[i, j] - truth[row, column]) <= radius
        ]
        held.append(len(inside))
        for i, j in inside if len(inside) >= 32 else []:
            weight = 1 / max(truth[i, j, 2], 0.1 * typical)
            wanted += scale * float(error[0, i, j].sum()) * weight / (3 * (2 * reach + 1) ** 2)
    assert max(held) >= 32
    found = full_local.local_loss(
        predicted + error, target, torch.tensor([scale]), level, torch.tensor([anchors])
    )
    assert found.item() == pytest.approx(wanted / len(anchors), rel=1e-3)


def test_normal_loss_ignores_scale_and_shift_but_not_a_tilt() -> None:
    target = scene(1)
    same = normal_loss(affine(target.points, 3.0, 1.0), target)
    angle = math.radians(20)
    turn = torch.tensor(
        [
            [math.cos(angle), 0, math.sin(angle)],
            [0, 1, 0],
            [-math.sin(angle), 0, math.cos(angle)],
        ]
    )
    assert float(same) < float(normal_loss(target.points @ turn.T, target)) / 10


def test_mask_loss_counts_sky_and_surfaces_but_not_the_unknown() -> None:
    target = scene(1)
    right = target.valid.float()
    right[:, -2:] = 17.0
    assert float(mask_loss(right, target)) == 0
    torch.testing.assert_close(mask_loss(1 - target.valid.float(), target), torch.tensor(1.0))


def clip(frames: int = 5, batch: int = 2) -> ClipTarget:
    return ClipTarget(scene(batch * frames, seed=1), frames)


@pytest.mark.parametrize("mode", ["first", "all"])
def test_clip_alignment_finds_one_scale_and_shift(mode: str) -> None:
    target = clip()
    points = affine(target.points, 0.5, 2.0)
    scale, shift = align_clips(points, target, mode)
    torch.testing.assert_close(scale, torch.full((2,), 0.5), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(shift[:, 2], torch.full((2,), 2.0), rtol=1e-3, atol=1e-3)
    assert float(clip_alignment_loss(points, target, scale, shift)) < 1e-3


def test_clip_alignment_sees_a_drift_that_frames_alone_do_not() -> None:
    target = clip()
    drift = torch.linspace(1, 2, 5)[None, :, None, None, None]
    points = target.points * drift
    alone = whole_frames(points.flatten(0, 1), target.frames)
    scale, shift = align_clips(points, target, "first")
    together = clip_alignment_loss(points, target, scale, shift)
    assert float(alone) < 1e-4
    assert float(together) > 0.3


def test_clip_with_nothing_valid_contributes_nothing() -> None:
    target = clip()
    valid = target.frames.valid.clone()
    valid[:5] = False
    empty = ClipTarget(
        Target(target.frames.points, valid, target.frames.infinite, target.frames.focal), 5
    )
    points = affine(target.points, 0.5, 2.0)
    scale, shift = align_clips(points, empty, "first")
    assert float(scale[0]) == 0
    full = align_clips(points, target, "first")
    torch.testing.assert_close(
        clip_alignment_loss(points * 1.1, empty, scale, shift),
        clip_alignment_loss(
            points[1:] * 1.1, ClipTarget(scene_part(target, 5), 5), full[0][1:], full[1][1:]
        ),
        rtol=1e-2,
        atol=1e-3,
    )


def scene_part(target: ClipTarget, start: int) -> Target:
    frames = target.frames
    return Target(*(getattr(frames, n)[start:] for n in ("points", "valid", "infinite", "focal")))


def test_temporal_loss_compares_how_far_points_move() -> None:
    target = clip()
    windows, frames, scale = (1, 2, 4), range(5), torch.full((2,), 0.5)
    assert len(window_pairs(frames, windows)) == 4 + 3 + 1
    still = affine(target.points, 0.5, 2.0)
    assert float(temporal_loss(still, target, scale, windows, frames)) < 1e-4
    drift = torch.linspace(1, 2, 5)[None, :, None, None, None]
    moving = affine(target.points, 0.5, 0) * drift
    loss = temporal_loss(moving, target, scale, windows, frames)
    assert float(loss) > 0.1
    assert torch.equal(loss, full_temporal.temporal_loss(moving, target, scale, windows))


def test_temporal_loss_without_pairs_or_alignment_is_zero() -> None:
    target = clip()
    points = target.points.clone().requires_grad_()
    alone = pair_motion_loss(points, target, torch.ones(2), [])
    released = full_temporal.temporal_loss(points, target, torch.ones(2), [8], "released")
    (alone + released).backward()
    assert alone.item() == 0
    assert released.item() == 0
    assert points.grad is not None and not points.grad.any()
    assert float(pair_motion_loss(target.points * 2, target, torch.zeros(2), [(0, 1)])) == 0


def test_pairs_are_found_among_frames_that_were_chosen() -> None:
    found = set(window_pairs([0, 3, 4, 5, 9], (1, 2, 4)))
    assert found == {(0, 2), (1, 2), (1, 3), (2, 3), (3, 4)}


def test_unknown_alignment_mode_is_refused() -> None:
    with pytest.raises(ValueError, match="'last'"):
        align_clips(clip().points, clip(), "last")


def noisy_clip() -> tuple[ClipTarget, Tensor]:
    target = clip(frames=3, batch=1)
    return target, affine(target.points, 0.5, 2.0) + 0.05 * normal(3, *target.points.shape)


def test_differentiable_alignment_is_close_to_the_exact_one() -> None:
    target, points = noisy_clip()
    for mode in ("first", "all"):
        torch.manual_seed(0)
        exact = align_clips(points, target, mode)
        torch.manual_seed(0)
        smooth = align_clips(points, target, mode, differentiable=True)
        torch.testing.assert_close(smooth[0], exact[0], rtol=0.05, atol=0)
        torch.testing.assert_close(smooth[1][:, 2], exact[1][:, 2], rtol=0.05, atol=0.05)


def test_gradient_through_the_first_frame_sees_that_it_moves_all_others() -> None:
    """Scaling the whole clip changes nothing, scaling the first frame alone does."""
    target, points = noisy_clip()

    def slope(frames: slice, differentiable: bool) -> float:
        factor = torch.ones(points.shape[1], requires_grad=True)
        scaled = points * factor[None, :, None, None, None]
        torch.manual_seed(0)
        scale, shift = align_clips(scaled, target, "first", differentiable)
        clip_alignment_loss(scaled, target, scale, shift).backward()
        assert factor.grad is not None
        return float(factor.grad[frames].sum())

    points = points * torch.tensor([1.0, 1.3, 1.4])[None, :, None, None, None]
    whole, first, others = slice(None), slice(0, 1), slice(1, None)
    assert abs(slope(whole, True)) < 1e-3
    assert slope(first, True) < -0.1 < 0.1 < slope(others, True)
    assert slope(whole, False) > 0.1  # detached, shrinking everything seems to help


def test_canonical_scale_is_depth_over_focal_and_blind_to_shape() -> None:
    target = scene()
    right = target.points / target.focal[:, None, None, None]
    assert canonical_scale_loss(right, target) == pytest.approx(0.0, abs=1e-9)
    off = 0.1
    expected = 0.5 * off**2 / HUBER
    assert canonical_scale_loss(right * math.exp(off), target) == pytest.approx(expected, rel=1e-3)


def test_spread_counts_each_frames_own_scale_and_not_the_clips() -> None:
    target = ClipTarget(scene(4), 4)
    points = target.points
    assert scale_spread_loss(5.0 * points, target) == pytest.approx(0.0, abs=1e-6)
    factors = torch.tensor([0.0, 0.2, 0.0, 0.2]).exp()[None, :, None, None, None]
    assert scale_spread_loss(points * factors, target) == pytest.approx(0.1, rel=1e-4)


def test_spread_of_a_clip_without_a_valid_pixel_is_zero_with_a_finite_gradient() -> None:
    empty = target_from_depth(torch.full((3, 8, 8), math.nan), INTRINSICS.expand(3, -1), 1.0)
    points = torch.ones(1, 3, 8, 8, 3, requires_grad=True)
    loss = scale_spread_loss(points, ClipTarget(empty, 3))
    loss.backward()
    assert float(loss) == 0.0
    assert points.grad is not None
    assert torch.isfinite(points.grad).all()


def test_normals_over_several_pixels_agree_on_the_truth() -> None:
    target = scene()
    best = normal_loss(target.points, target, stride=4)
    assert best < normal_loss(target.points * torch.tensor([1.0, 1.0, 1.5]), target, stride=4)
