"""What a step of the paper's objective costs, and what its alignments would cost without bounds.

python benchmarks/text_objective.py bags/demo

One clip of 12 frames of the recording goes through dyfn-mini at 192 x 256; the objective's terms
and gradients are computed with the alignments as they are, and with those that try every sample
(tests/support/every_anchor.py), on the same anchors. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import torch
from torch import Tensor

from dyfn_core import load_model
from dyfn_core.data.clips import ClipSource, SizeStage, draw_batch, find_sequences
from dyfn_core.data.pool import DataSpec
from dyfn_core.losses.full import local, whole_frame
from dyfn_core.losses.full.objective import Objective
from dyfn_core.losses.target import ClipTarget, target_from_depth
from dyfn_core.models.base import AffinePoints, Latent
from dyfn_core.training.tasks.dyfn import unroll
from dyfn_core.training.tasks.latent_cache import LatentClips, encode_clips
from tests.support.every_anchor import align_through_every_sample

SIZE, FRAMES = (192, 256), 12


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    recording = parser.parse_args().recording
    torch.set_num_threads(1)
    stage = SizeStage(0, (SIZE,), 1)
    source = ClipSource((DataSpec(recording),), ("clip",), FRAMES, (1, 2), (stage,))
    model = load_model("dyfn-mini")
    model.requires_grad_(False)
    assert model.stabilizer is not None
    model.stabilizer.requires_grad_(True)
    clips = encode_clips(model, draw_batch(source, find_sequences(source, "train"), 0))
    ours = timed(lambda: step(model, clips))
    with (
        mock.patch.object(whole_frame, "align_points", align_through_every_sample),
        mock.patch.object(local, "align_points", align_through_every_sample),
    ):
        theirs = timed(lambda: step(model, clips))
    for name, value in ours[1].items():
        print(f"{name}: {value:.6f}, through every sample {theirs[1][name]:.6f}")
    print(f"largest difference of the gradient: {float((ours[2] - theirs[2]).abs().max()):.1e}")
    print(f"largest entry of the gradient: {float(ours[2].abs().max()):.1e}")
    print(f"a step: {ours[0]:.1f} s, through every sample {theirs[0]:.1f} s")
    print(f"ratio: {theirs[0] / ours[0]:.1f}")


def step(model: torch.nn.Module, clips: LatentClips) -> tuple[dict[str, float], Tensor]:
    """DyFN unrolled, decoded at half size, the text's objective and its gradient."""
    torch.manual_seed(0)
    model.zero_grad(set_to_none=True)
    stabilized = unroll(model, clips)  # type: ignore[arg-type]
    features = torch.stack([latent.features for latent in stabilized], 1).flatten(0, 1)
    half = (SIZE[0] // 2, SIZE[1] // 2)
    affine = model.decode(Latent(features, half, stabilized[0].network_size))  # type: ignore[operator]
    assert isinstance(affine, AffinePoints)
    truth = target_from_depth(
        clips.depth.float().flatten(0, 1), clips.intrinsics.flatten(0, 1), SIZE[1] / SIZE[0]
    )
    objective = Objective()
    terms = objective.terms(
        affine.points[None].float(), affine.mask[None].float(), ClipTarget(truth, FRAMES)
    )
    objective.total(terms).backward()
    gradients = [p.grad.flatten() for p in model.stabilizer.parameters()]  # type: ignore[union-attr]
    return {name: float(term.detach()) for name, term in terms.items()}, torch.cat(gradients)


def timed(
    work: Callable[[], tuple[dict[str, float], Tensor]],
) -> tuple[float, dict[str, float], Tensor]:
    start = time.process_time()
    found = work()
    return time.process_time() - start, *found


if __name__ == "__main__":
    main()
