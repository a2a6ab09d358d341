"""Focal and shift recovered causally over time against per frame, on a recording with truth.

    python benchmarks/shift_modes.py RECORDING [--model dyfn-mini] [--every N] [--max-frames N]

The network runs once per frame; every row is another way to recover the camera from the same
point maps. "scale only" aligns the sequence with one scale and no shift: what a robot gets that
knows its scale. Log scale: of each frame's median against the truth.
"""

from __future__ import annotations

import argparse
from itertools import islice

import numpy as np
import torch

from dyfn_core import DepthStream, StreamState, load_model
from dyfn_core.models.base import image_to_batch
from dyfn_core.scoring.protocols import SequenceScorer, to_shape
from dyfn_core.stream.depth_stream import SHIFT_MODES
from dyfn_ros.recordings.open import open_recording


class Row:
    """One way to recover the camera, and how it did."""

    def __init__(self, stream: DepthStream, known: bool) -> None:
        self.stream, self.known = stream, known
        self.scorer = SequenceScorer()
        self.ratios: list[np.ndarray] = []

    def push(self, points: tuple, camera: np.ndarray | None, truth: np.ndarray) -> None:
        """points: affine points and state of one frame; truth: H x W metres, NaN invalid."""
        self.stream.camera_matrix = camera if self.known else None
        prediction = self.stream.finish(*points)
        depth = to_shape(prediction.depth.numpy(), truth.shape)
        self.scorer.push(depth, truth)
        usable = np.isfinite(depth) & np.isfinite(truth)
        if usable.any():
            self.ratios.append((depth[usable] / truth[usable])[::7])

    def line(self, name: str) -> str:
        """The row of the table."""
        image, video = self.scorer.image(), self.scorer.video()
        if image is None or video is None:
            return f"| {name} | no frame could be scored |"
        medians = np.log([np.median(ratio) for ratio in self.ratios])
        scale = np.exp(np.median(medians))
        alone = np.mean([np.abs(ratio / scale - 1).mean() for ratio in self.ratios])
        cells = [
            f"{image.metrics['abs_rel']:.4f}",
            f"{video.metrics['abs_rel']:.4f}",
            f"{video.metrics['delta1']:.3f}",
            f"{alone:.4f}",
            f"{medians.std():.4f}",
            f"{np.abs(np.diff(medians)).max():.4f}",
        ]
        return f"| {name} | {' | '.join(cells)} |"


def main() -> None:
    """Run and print a Markdown table per stabilizer setting."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording")
    parser.add_argument("--model", default="dyfn-mini")
    parser.add_argument("--every", type=int, default=1, help="use every Nth frame")
    parser.add_argument("--max-frames", type=int, default=None)
    options = parser.parse_args()
    model = load_model(options.model)
    for stabilize in (False, True) if model.stabilizer is not None else (False,):
        rows = {
            (mode, known): Row(DepthStream(model, stabilize=stabilize, shift_mode=mode), known)
            for known in (True, False)
            for mode in SHIFT_MODES
        }
        state: StreamState | None = None
        frames = islice(open_recording(options.recording).frames(), options.max_frames)
        for frame in islice(frames, 0, None, options.every):
            with torch.inference_mode():
                batch, _ = image_to_batch(frame.image, model.device)
                points = model.predict_affine(batch, state, stabilize=stabilize)
                state = points[1]
                if frame.depth is not None:
                    for row in rows.values():
                        row.push(points, frame.camera_matrix, frame.depth)
        print(f"\nDyFN {'on' if stabilize else 'off'}, {options.model}, {options.recording}\n")
        print(
            "| shift | image AbsRel | video AbsRel | video delta1 | scale only | std | max step |"
        )
        print("| --- | --- | --- | --- | --- | --- | --- |")
        for (mode, known), row in rows.items():
            print(row.line(f"{mode}, {'known' if known else 'unknown'} camera"))


if __name__ == "__main__":
    main()
