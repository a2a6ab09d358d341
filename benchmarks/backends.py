"""The libraries that run the network, as ratios to eager torch within one run.

    python benchmarks/backends.py [--backends onnxruntime openvino] [--frames 25] [--out FILE.json]

Each row is a stream with DyFN. Frames go to the libraries in turn, on one thread; the figure is the
process's CPU time of a push, the median after three frames: a loaded machine changes it little. The
ViT-S is MoGe v1 with random weights, whose speed is that of any weights. The table is written in
Markdown on stdout, with the processor and its instruction sets.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from dyfn_core import DepthStream, load_model
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.export.backends import on_backend
from dyfn_core.models.moge import MoGeModel
from dyfn_ros.recordings.open import open_recording

SIZE = (480, 640)
WARM = 3  # frames that are not counted
SETS = ("avx2", "avx512f", "avx_vnni", "avx512_vnni", "avx512_bf16", "amx_int8", "amx_bf16")
VITS = {
    "encoder": "dinov2_vits14",
    "intermediate_layers": 4,
    "dim_proj": 512,
    "dim_upsample": [256, 128, 64],
    "dim_times_res_block_hidden": 2,
    "num_res_blocks": 2,
    "last_conv_channels": 32,
    "last_conv_size": 1,
    "remap_output": "exp",
}


class Case(NamedTuple):
    """A model at a resolution; frames: how many are pushed."""

    label: str
    model: GeometryModel
    num_tokens: int | None
    frames: int


class Row(NamedTuple):
    """milliseconds: CPU time of a push. difference: largest relative one of depth, from torch's."""

    case: str
    backend: str
    milliseconds: float
    ratio: float
    difference: float


def vits() -> GeometryModel:
    """MoGe v1 ViT-S with random weights and a DyFN as released."""
    torch.manual_seed(0)
    model = MoGeModel.from_config(VITS)
    model.stabilizer = build_dyfn(model.latent_channels, DyFNConfig())
    return model.eval()


def machine() -> str:
    """The processor and which of SETS it has."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    said = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    flags = said.get("flags", "").split()
    name = said.get("model name", "unknown processor")
    return f"{name}: {', '.join(one for one in SETS if one in flags) or 'none of ' + str(SETS)}"


def measured(case: Case, backends: list[str], images: list[np.ndarray]) -> list[Row]:
    """One row for torch and for each backend."""
    names = ["torch", *backends]
    streams = {
        name: DepthStream(on_backend(case.model, name), num_tokens=case.num_tokens)
        for name in names
    }
    spent: dict[str, list[float]] = {name: [] for name in names}
    worst = dict.fromkeys(names, 0.0)
    for image in images[: case.frames]:
        found = {}
        for name, stream in streams.items():
            start = time.process_time()
            found[name] = stream.push(image)
            spent[name].append(1e3 * (time.process_time() - start))
        exact = found["torch"]
        for name, one in found.items():
            both = exact.valid & one.valid
            if both.any():
                change = (one.depth[both] / exact.depth[both] - 1).abs().max()
                worst[name] = max(worst[name], float(change))
    middle = {name: statistics.median(values[WARM:]) for name, values in spent.items()}
    return [
        Row(case.label, name, middle[name], middle["torch"] / middle[name], worst[name])
        for name in names
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--backends", nargs="+", default=["onnxruntime", "openvino"])
    parser.add_argument("--recording", type=Path, default=Path("bags/demo"))
    parser.add_argument("--frames", type=int, default=25)
    parser.add_argument("--tokens", type=int, default=300, help="of the ViT-S")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    recorded = islice(open_recording(options.recording).frames(), options.frames)
    images = [cv2.resize(frame.image, SIZE[::-1]) for frame in recorded]
    few = WARM + max(3, options.frames // 5)
    cases = [
        Case("dyfn-mini", load_model("dyfn-mini"), None, options.frames),
        Case(f"MoGe v1 ViT-S, {options.tokens} tokens", vits(), options.tokens, few),
    ]
    print(f"{machine()}; one thread, images of {SIZE[1]}x{SIZE[0]}\n")
    print("| model | library | ms of CPU a frame | times as fast | largest difference of depth |")
    print("| --- | --- | --- | --- | --- |")
    rows = []
    for case in cases:
        for row in measured(case, options.backends, images):
            rows.append(row)
            print(
                f"| {row.case} | {row.backend} | {row.milliseconds:.1f} | {row.ratio:.2f} "
                f"| {row.difference:.1e} |",
                flush=True,
            )
    if options.out:
        told = {"machine": machine(), "rows": [row._asdict() for row in rows]}
        options.out.write_text(json.dumps(told, indent=2) + "\n")


if __name__ == "__main__":
    main()
