"""What holds no truth contributes nothing: zero loss, zero and finite gradients, in every term."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from dyfn_core.losses.canonical_scale import canonical_scale_loss
from dyfn_core.losses.clip_alignment import clip_alignment_loss
from dyfn_core.losses.full import clip_alignment as full_clips
from dyfn_core.losses.full import local as full_local
from dyfn_core.losses.full import mask as full_mask
from dyfn_core.losses.full import normal as full_normal
from dyfn_core.losses.full import temporal as full_temporal
from dyfn_core.losses.full import whole_frame as full_frames
from dyfn_core.losses.full.objective import Objective
from dyfn_core.losses.full.ssi import ssi_loss
from dyfn_core.losses.sampled.clip_alignment import align_clips
from dyfn_core.losses.sampled.disparity import (
    align_disparity,
    disparity_alignment_loss,
    disparity_temporal_loss,
)
from dyfn_core.losses.sampled.local import local_loss
from dyfn_core.losses.sampled.mask import mask_loss
from dyfn_core.losses.sampled.normal import normal_loss
from dyfn_core.losses.sampled.temporal import temporal_loss
from dyfn_core.losses.sampled.whole_frame import align_frames, global_loss
from dyfn_core.losses.scale_spread import scale_spread_loss
from dyfn_core.losses.target import ClipTarget, target_from_depth
from tests.support.seeded import uniform

FRAMES, HEIGHT, WIDTH = 3, 20, 28
PAIRS = [(0, 1), (0, 2)]
LEVEL = full_local.LocalLevel(1 / 2, 6, 4)


def aligned(mode: str, full: bool) -> Callable[[Tensor, ClipTarget], Tensor]:
    def term(points: Tensor, target: ClipTarget) -> Tensor:
        find = full_clips.align_clips if full else align_clips
        return clip_alignment_loss(points, target, *find(points, target, mode))

    return term


def disparity_of(points: Tensor) -> Tensor:
    return 1 / points[..., 2]


def by_frame(term: Callable[..., Tensor]) -> Callable[[Tensor, ClipTarget], Tensor]:
    return lambda points, target: term(points.flatten(0, 1), target.frames).sum()


def own_frames(points: Tensor, target: ClipTarget) -> Tensor:
    flat = points.flatten(0, 1)
    return global_loss(flat, target.frames, *align_frames(flat, target.frames))


def full_own_frames(points: Tensor, target: ClipTarget) -> Tensor:
    flat = points.flatten(0, 1)
    scale, shift = full_frames.align_frames(flat, target.frames, 8)
    return full_frames.global_loss(flat, target.frames, scale, shift).sum()


TERMS: dict[str, Callable[[Tensor, ClipTarget], Tensor]] = {
    "align_first": aligned("first", False),
    "align_all": aligned("all", False),
    "full_align_first": aligned("first", True),
    "full_align_all": aligned("all", True),
    "temporal": lambda p, t: temporal_loss(
        p, t, align_clips(p, t, "first")[0], (1, 2), range(FRAMES)
    ),
    "full_temporal": lambda p, t: full_temporal.temporal_loss(
        p, t, align_clips(p, t, "first")[0], (1, 2)
    ),
    "full_temporal_released": lambda p, t: full_temporal.temporal_loss(
        p, t, align_clips(p, t, "first")[0], (1, 2), "released"
    ),
    "frame": own_frames,
    "full_frame": full_own_frames,
    "local": lambda p, t: local_loss(p.flatten(0, 1), t.frames, torch.ones(FRAMES), 1 / 2, 6),
    "full_local": by_frame(lambda p, t: full_local.local_loss(p, t, None, LEVEL)),
    "normal": by_frame(normal_loss),
    "full_normal": by_frame(full_normal.normal_loss),
    "edge": by_frame(full_normal.edge_loss),
    "canonical_scale": by_frame(canonical_scale_loss),
    "spread": scale_spread_loss,
    "ssi": lambda p, t: ssi_loss(disparity_of(p).flatten(0, 1), t.frames),
    "disparity_align": lambda p, t: disparity_alignment_loss(
        disparity_of(p), t, *align_disparity(disparity_of(p), t, "first")
    ),
    "disparity_temporal": lambda p, t: disparity_temporal_loss(
        disparity_of(p), t, align_disparity(disparity_of(p), t, "first")[0], PAIRS
    ),
}
# These see single frames, or compare frames under an alignment from all: one frame is enough.
ALONE = {
    "align_first", "align_all", "full_align_first", "full_align_all", "frame", "full_frame",
    "local", "full_local", "normal", "full_normal", "edge", "canonical_scale", "ssi",
    "disparity_align",
}  # fmt: skip


def depth(kind: str) -> Tensor:
    coarse = 1 + 4 * uniform(0, FRAMES, 1, 3, 3)
    found = torch.nn.functional.interpolate(
        coarse, size=(HEIGHT, WIDTH), mode="bilinear", align_corners=True
    )[:, 0]
    if kind == "invalid":
        return torch.full_like(found, math.nan)
    if kind == "infinite":
        return torch.full_like(found, math.inf)
    if kind == "first":
        found[1:] = math.nan
    if kind == "last":
        found[:-1] = math.inf
    return found


def run(name: str, kind: str) -> tuple[float, Tensor]:
    frames = target_from_depth(
        depth(kind), torch.tensor([0.8, 1.12, 0.5, 0.5]).expand(FRAMES, -1), WIDTH / HEIGHT
    )
    target = ClipTarget(frames, FRAMES)
    full = target_from_depth(
        depth("full"), torch.tensor([0.8, 1.12, 0.5, 0.5]).expand(FRAMES, -1), WIDTH / HEIGHT
    )
    torch.manual_seed(1)
    points = full.points[None] * (1 + 0.2 * uniform(1, 1, FRAMES, HEIGHT, WIDTH, 3))
    points = points.requires_grad_()
    loss = TERMS[name](points, target)
    loss.backward()
    assert points.grad is not None
    return float(loss.detach()), points.grad[0]


@pytest.mark.parametrize("kind", ["invalid", "infinite"])
@pytest.mark.parametrize("name", TERMS)
def test_clip_without_truth_is_nothing(name: str, kind: str) -> None:
    loss, gradient = run(name, kind)
    assert loss == 0
    assert not bool(gradient.any())


@pytest.mark.parametrize("name", TERMS)
def test_clip_with_one_valid_frame_moves_that_frame_at_most(name: str) -> None:
    for kind, valid in (("first", 0), ("last", FRAMES - 1)):
        loss, gradient = run(name, kind)
        assert math.isfinite(loss)
        assert bool(torch.isfinite(gradient).all())
        others = [j for j in range(FRAMES) if j != valid]
        assert not bool(gradient[others].any())
        if kind == "first" and name in ALONE:
            assert loss > 0
        if name not in ALONE:
            assert loss == 0


@pytest.mark.parametrize("name", TERMS)
def test_clip_with_truth_has_a_gradient(name: str) -> None:
    loss, gradient = run(name, "full")
    assert loss > 0
    assert bool(torch.isfinite(gradient).all())
    assert bool(gradient.any())


@pytest.mark.parametrize("kind", ["invalid", "infinite"])
def test_masks_see_the_sky_but_not_the_unknown(kind: str) -> None:
    frames = target_from_depth(depth(kind), torch.tensor([[0.8, 1.12, 0.5, 0.5]] * FRAMES), 1.4)
    mask = torch.full((FRAMES, HEIGHT, WIDTH), 0.5, requires_grad=True)
    loss = mask_loss(mask, frames) + full_mask.mask_loss(mask, frames).sum()
    loss.backward()
    assert mask.grad is not None
    assert bool(mask.grad.any()) == (kind == "infinite")


def test_ssi_ignores_scale_and_shift_but_not_shape() -> None:
    frames = target_from_depth(depth("full"), torch.tensor([[0.8, 1.12, 0.5, 0.5]] * FRAMES), 1.4)
    true = 1 / frames.points[..., 2]
    factors = torch.tensor([0.1, 1.0, 40.0])[:, None, None]
    assert float(ssi_loss(factors * true + factors - 3, frames)) < 1e-4
    assert float(ssi_loss(true.square(), frames)) > 0.02
    spoiled = true.clone()
    spoiled[:, 3:5, 3:5] += 100
    trimmed, kept = ssi_loss(spoiled, frames), ssi_loss(spoiled, frames, trim=0.0)
    assert float(trimmed) < float(kept)


def test_ssi_of_a_frame_is_midas_error_computed_by_hand() -> None:
    draw = np.random.default_rng(5)
    z, ours = draw.uniform(1, 5, (2, HEIGHT, WIDTH))
    z[4:7, :9] = np.nan
    known = np.isfinite(z)

    def normalised(values: np.ndarray) -> np.ndarray:
        ordered = np.sort(values[known])
        centred = values - ordered[(len(ordered) - 1) // 2]
        return np.where(known, centred / np.abs(centred[known]).mean(), 0)

    residual = normalised(ours) - normalised(np.where(known, 1 / z, 0))
    kept = np.sort(np.abs(residual[known]))[: int(0.8 * known.sum())]
    wanted = kept.sum() / (2 * known.sum())
    for step in (1, 2, 4, 8):
        r, k = residual[::step, ::step], known[::step, ::step]
        across = (np.abs(np.diff(r, axis=1)) * (k[:, 1:] & k[:, :-1])).sum()
        down = (np.abs(np.diff(r, axis=0)) * (k[1:] & k[:-1])).sum()
        wanted += 0.5 * (across + down) / k.sum()
    frame = target_from_depth(
        torch.from_numpy(z).float()[None], torch.tensor([[0.8, 1.12, 0.5, 0.5]]), 1.4
    )
    found = float(ssi_loss(torch.from_numpy(ours).float()[None], frame))
    assert found == pytest.approx(wanted, rel=1e-5)


def test_disparity_alignment_finds_scale_and_shift() -> None:
    frames = target_from_depth(depth("full"), torch.tensor([[0.8, 1.12, 0.5, 0.5]] * FRAMES), 1.4)
    target = ClipTarget(frames, FRAMES)
    disparity = ((1 / frames.points[..., 2]) - 0.2)[None] / 3
    for mode in ("first", "all"):
        scale, shift = align_disparity(disparity, target, mode)
        assert float(scale) == pytest.approx(3, rel=1e-3)
        assert float(shift) == pytest.approx(0.2, abs=1e-3)
        assert float(disparity_alignment_loss(disparity, target, scale, shift)) < 1e-4
        assert float(disparity_temporal_loss(disparity, target, scale, PAIRS)) < 1e-4
    with pytest.raises(ValueError, match="'last'"):
        align_disparity(disparity, target, "last")


@pytest.mark.parametrize("form", ["text", "released"])
def test_every_term_of_the_objective_can_be_switched_off(form: str) -> None:
    frames = target_from_depth(depth("full"), torch.tensor([[0.8, 1.12, 0.5, 0.5]] * FRAMES), 1.4)
    target = ClipTarget(frames, FRAMES)
    noise = uniform(2, *frames.points.shape)
    points = (frames.points * (1 + 0.1 * noise))[None].requires_grad_()
    mask = torch.full((1, FRAMES, HEIGHT, WIDTH), 0.3)
    names = ("align_first", "align_all", "frame", "local", "normal", "mask", "edge", "temporal")
    off = dict.fromkeys(names, 0.0)
    shared = {"form": form, "levels": (LEVEL,), "windows": (1,), "resolution": 8}
    full = Objective(**{**dict.fromkeys(names, 1.0), **shared})  # type: ignore[arg-type]
    torch.manual_seed(2)
    everything = full.terms(points, mask, target)
    for name in names:
        objective = Objective(**{**off, **shared, name: 2.0})  # type: ignore[arg-type]
        torch.manual_seed(2)
        terms = objective.terms(points, mask, target)
        (only,) = terms
        assert only.startswith(name)
        torch.testing.assert_close(terms[only], everything[only])
        total = objective.total(terms, FRAMES)
        share = 1 / (FRAMES + 1) if (form, name) == ("released", "temporal") else 1
        torch.testing.assert_close(total, 2 * share * terms[only])


def test_objective_of_a_clip_without_truth_is_zero() -> None:
    frames = target_from_depth(depth("invalid"), torch.tensor([[0.8, 1.12, 0.5, 0.5]] * FRAMES), 1)
    points = torch.ones(1, FRAMES, HEIGHT, WIDTH, 3, requires_grad=True)
    for objective in (Objective(levels=(LEVEL,)), Objective(form="released", levels=(LEVEL,))):
        terms = objective.terms(points, points[..., 0], ClipTarget(frames, FRAMES))
        total = objective.total(terms, FRAMES)
        points.grad = None
        total.backward()
        assert float(total.detach()) == 0
        assert points.grad is not None
        assert not bool(points.grad.any())


def test_unknown_form_is_refused() -> None:
    with pytest.raises(ValueError, match="'paper'"):
        Objective(form="paper")
