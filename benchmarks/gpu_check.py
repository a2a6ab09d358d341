"""What a GPU computes beside the CPU, and how fast: parity, bf16, frames and training steps.

    make gpu-check                      # all of it, and docs/GPU.md
    python benchmarks/gpu_check.py --device cpu --models dyfn-mini --frames 3 --page out.md

Every model runs a stream on the CPU and on the device in float32 (TF32 off), then on the device
alone in bfloat16 where the network is. Depth is compared where both are valid, relative to the
CPU's. Random weights stand for the released ones: speed and rounding do not depend on them. A
check that fails makes the exit status 1. Without a GPU nothing is written.
"""

from __future__ import annotations

import argparse
import os
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import load_model
from dyfn_core.models.depth_anything import DepthAnythingConfig, DepthAnythingModel
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.moge import MoGeModel
from dyfn_core.stream.depth_stream import DepthStream

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "GPU.md"
BEGIN, END = "<!-- checked: written by `make gpu-check` -->", "<!-- end of checked -->"
WARM = 3
CLOSE, BF16_CLOSE = 1e-3, 0.1  # largest relative difference in float32, median one in bf16
TRAINING = ROOT / "config" / "train_dyfn_unrolled_mini.yaml"
MOGE = {
    "intermediate_layers": 4,
    "dim_proj": 512,
    "dim_upsample": [256, 128, 64],
    "dim_times_res_block_hidden": 2,
    "num_res_blocks": 2,
    "last_conv_channels": 32,
    "last_conv_size": 1,
    "remap_output": "exp",
}
BASE = ROOT / "dyfn_core" / "weights" / "dyfn-mini-9.safetensors"


def _with_dyfn(model: GeometryModel) -> GeometryModel:
    model.stabilizer = build_dyfn(model.latent_channels, DyFNConfig())
    return model.eval()


def _moge(encoder: str) -> GeometryModel:
    torch.manual_seed(0)
    return _with_dyfn(MoGeModel.from_config({**MOGE, "encoder": encoder}))


def _depth_anything() -> GeometryModel:
    torch.manual_seed(0)
    model = DepthAnythingModel(DepthAnythingConfig())
    torch.nn.init.ones_(model.depth_head.scratch.output_conv2[2].bias)  # disparity around 1
    return _with_dyfn(model)


MODELS: dict[str, Callable[[], GeometryModel]] = {
    "dyfn-mini": lambda: load_model("dyfn-mini"),
    "MoGe v1 ViT-S": lambda: _moge("dinov2_vits14"),
    "MoGe v1 ViT-L": lambda: _moge("dinov2_vitl14"),
    "Depth Anything V2": _depth_anything,
}


@dataclass(frozen=True)
class Checked:
    """One model on the device.

    worst: largest relative difference of depth from the CPU's, both in float32. bf16: median one
    of bfloat16 from the device's float32. frames, bf16_frames: a second, medians.
    """

    model: str
    worst: float
    bf16: float
    frames: float
    bf16_frames: float

    def wrong(self) -> Iterator[str]:
        """What is out of its bounds."""
        if not self.worst < CLOSE:
            yield f"{self.model}: float32 differs from the CPU's by {self.worst:.1e}, not {CLOSE:g}"
        if not self.bf16 < BF16_CLOSE:
            yield f"{self.model}: bfloat16 differs by {self.bf16:.1e} (median), not {BF16_CLOSE:g}"


def pictures(count: int) -> list[np.ndarray]:
    """A texture that drifts and changes its brightness, 480 x 640 x 3 uint8."""
    rng = np.random.default_rng(0)
    coarse = rng.uniform(0, 255, (40, 50, 3)).repeat(16, axis=0).repeat(16, axis=1)
    return [
        (coarse[i : i + 480, 2 * i : 2 * i + 640] * (0.7 + 0.3 * np.cos(i / 5))).astype(np.uint8)
        for i in range(count)
    ]


def check(name: str, device: torch.device, frames: int) -> Checked:
    """Run one model on the CPU and on the device."""
    images = pictures(frames)
    on_cpu, _ = _streamed(MODELS[name](), images)
    model = MODELS[name]().to(device)
    exact, seconds = _streamed(model, images)
    rounded, rounded_seconds = _streamed(model, images, torch.autocast(device.type, torch.bfloat16))
    return Checked(
        name,
        max(float(change.max()) for change in _changes(exact, on_cpu)),
        statistics.median(float(change.median()) for change in _changes(rounded, exact)),
        1 / seconds,
        1 / rounded_seconds,
    )


def _streamed(
    model: GeometryModel,
    images: Sequence[np.ndarray],
    precision: AbstractContextManager[object] | None = None,
) -> tuple[list[torch.Tensor], float]:
    """Depth of each image on the CPU, NaN where it is invalid, and median seconds of a push."""
    stream, depths, spent = DepthStream(model), [], []
    with precision or nullcontext():
        for image in images:
            began = time.perf_counter()
            found = stream.push(image)
            depth = found.depth.float().masked_fill(~found.valid, torch.nan).cpu()  # waits
            spent.append(time.perf_counter() - began)
            depths.append(depth)
    return depths, statistics.median(spent[min(WARM, len(spent) - 1) :])


def _changes(found: Sequence[torch.Tensor], exact: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    changes = [(one / other - 1).abs() for one, other in zip(found, exact, strict=True)]
    finite = [change[change.isfinite()] for change in changes]
    return [change for change in finite if change.numel()] or [torch.full((1,), torch.nan)]


def training(device: torch.device) -> str:
    """What `dyfn-train dyfn --dry-run` says of a step on the device."""
    words = ["dyfn", str(TRAINING), "--out", "unused", "--dry-run", "--set", f"base={BASE}"]
    hidden = {"CUDA_VISIBLE_DEVICES": ""} if device.type == "cpu" else {}
    code = [sys.executable, "-m", "dyfn_core.cli.train", *words]
    done = subprocess.run(
        code, capture_output=True, text=True, timeout=400, env={**os.environ, **hidden}
    )
    if done.returncode:
        raise RuntimeError(f"dyfn-train --dry-run ended with {done.returncode}: {done.stderr}")
    return done.stdout.strip().splitlines()[0]


@contextmanager
def exact_products() -> Iterator[None]:
    """Float32 without TF32."""
    before = torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32
    torch.set_float32_matmul_precision("highest")
    torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before[0])
        torch.backends.cudnn.allow_tf32 = before[1]


def table(rows: Sequence[Checked], machine: str, step: str | None) -> str:
    """The page's part between its markers."""
    lines = [
        f"{machine}, torch {torch.__version__}.\n",
        "| model | largest difference, float32 | median difference, bf16 | frames/s | bf16 |",
        "| --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {row.model} | {row.worst:.1e} | {row.bf16:.1e} | {row.frames:.1f} | "
        f"{row.bf16_frames:.1f} |"
        for row in rows
    ]
    return "\n".join(lines + ([f"\nTraining: {step}."] if step else []))


def write_page(path: Path, content: str) -> None:
    """Put the content between the page's markers."""
    text = path.read_text(encoding="utf-8")
    place = re.compile(f"{re.escape(BEGIN)}.*{re.escape(END)}", re.DOTALL)
    if not place.search(text):
        raise ValueError(f"{path}: expected {BEGIN!r} and {END!r}")
    path.write_text(place.sub(lambda _: f"{BEGIN}\n{content}\n{END}", text), encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """-> exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=MODELS)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--no-training", action="store_true")
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args(arguments)
    device = torch.device(options.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        print("gpu-check: torch finds no GPU here; nothing was run or written", file=sys.stderr)
        return 2
    with exact_products():
        rows = [check(name, device, options.frames) for name in options.models]
    step = None if options.no_training else training(device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "The CPU"
    write_page(options.page, table(rows, name, step))
    wrong = [told for row in rows for told in row.wrong()]
    for told in wrong:
        print(f"gpu-check: {told}", file=sys.stderr)
    print(options.page.read_text(encoding="utf-8"))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
