"""A file of dyfn-export beside the model that it was made of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyfn_core.models.base import GeometryModel
from dyfn_core.models.export.parts import NEXT, affine_from, state_from, state_tensors
from dyfn_core.models.export.session import load_step
from dyfn_core.prediction import StreamState

SIZE, TOKENS = (90, 120), 24
FRAMES = 50
CLOSE = 1e-4  # relative, of depth


def walk(count: int) -> list[Tensor]:
    """Pictures that drift over a texture and change their brightness, 1 x 3 x H x W."""
    rng = np.random.default_rng(0)
    coarse = torch.from_numpy(rng.uniform(0, 1, (1, 3, 30, 40))).float()
    world = torch.nn.functional.interpolate(coarse, scale_factor=6, mode="bicubic").clamp(0, 1)
    height, width = SIZE
    return [
        world[..., i : i + height, i : i + width] * (0.7 + 0.3 * np.cos(i / 5))
        for i in range(count)
    ]


def largest_difference(
    model: GeometryModel, path: Path, stabilize: bool, frames: int = FRAMES
) -> float:
    """Of depth, relative, over a stream whose state each side carries by itself."""
    info, session = load_step(path)
    after: StreamState | None = None
    carried = {
        name: torch.zeros(shape) if info.first_state[name] == "zeros" else torch.full(shape, np.nan)
        for name, shape in info.state.items()
    }
    worst = 0.0
    with torch.inference_mode():
        for image in walk(frames):
            expected, after = model.predict_affine(image, after, TOKENS, stabilize)
            pixels = model.prepare(image, TOKENS).pixels
            found = session.run({"image": pixels, **carried})
            if info.stabilized:
                carried = state_tensors(state_from(found, NEXT))
            values = affine_from(found).values
            worst = max(worst, float((values / expected.values - 1).abs().max()))
    return worst
