"""The DyFN of one model on the base of another that comes from the same start.

    python benchmarks/move_dyfn.py dyfn-mini runs/mean.safetensors --out runs/moved.safetensors \
        --images data/rooms_usual data/real/train

The recurrence sees every channel of the latent less its usual mean, over its usual deviation: both
are moved as the latents of the same pictures moved from the old base to the new one. Its
corrections are multiplied by --gain; --half stores float16. Nothing is trained.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from dyfn_core.models.base import GeometryModel, image_to_batch
from dyfn_core.models.checkpoints import load_model, save_model


@torch.inference_mode()
def statistics(model: GeometryModel, reader: GeometryModel, files: list[Path]) -> list[Tensor]:
    """Mean and deviation of every channel that the reader's DyFN sees, float64."""
    stabilizer = reader.stabilizer
    assert stabilizer is not None
    seen = []
    for file in files:
        image = cv2.imread(str(file))
        if image is None:
            raise FileNotFoundError(f"{file} is no image")
        pixels, _ = image_to_batch(np.ascontiguousarray(image[..., ::-1]), model.device)
        features = model.encode(pixels).features
        seen.append(stabilizer.gru_input(features, features.mean((-2, -1)))[0].flatten(1))
    channels = torch.cat(seen, 1).double()
    return [channels.mean(1), channels.std(1).clamp(min=1e-6)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("old", help="checkpoint or name, with DyFN")
    parser.add_argument("new", help="checkpoint or name, for its base")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--images", type=Path, nargs="+", required=True, help="roots of *.jpg")
    parser.add_argument("--count", type=int, default=100, help="pictures, as many of each root")
    parser.add_argument("--gain", type=float, default=1.0, help="of DyFN's corrections")
    parser.add_argument("--half", action="store_true", help="store float16")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    files: list[Path] = []
    for root in options.images:
        found = sorted(root.glob("**/*.jpg"))
        share = min(len(found), options.count // len(options.images))
        files += [found[i] for i in np.linspace(0, len(found) - 1, share).round().astype(int)]
    old, new = load_model(options.old), load_model(options.new)
    before, after = (statistics(model, old, files) for model in (old, new))
    new.stabilizer = old.stabilizer
    assert new.stabilizer is not None
    mean, std = (new.stabilizer.get_buffer(name) for name in ("usual_mean", "usual_std"))
    ratio = after[1] / before[1]
    moved = (mean.double() - before[0]) * ratio + after[0]
    print(f"means moved by {((after[0] - before[0]) / before[1]).abs().mean():.2f} deviations,")
    print(f"deviations by a factor of {ratio.log().abs().mean().exp():.2f}, on average")
    mean.copy_(moved.to(mean.dtype))
    std.copy_((std.double() * ratio).to(std.dtype))
    for head in (new.stabilizer.gamma_head, new.stabilizer.beta_head):
        assert isinstance(head, torch.nn.Conv2d) and head.bias is not None
        head.weight.data.mul_(options.gain)
        head.bias.data.mul_(options.gain)
    save_model(new, options.out, torch.float16 if options.half else None)


if __name__ == "__main__":
    main()
