"""Does anything that the node knows about a pixel say how wrong its depth is?

    python benchmarks/confidence.py [--recording bags/demo] [--model dyfn-mini] [--frames 60]

For each candidate: Spearman's rank correlation with the relative error after the frame's own scale
and shift (image protocol), over the pixels of a frame with truth, mean over frames; and the AbsRel
of the half of the pixels that it trusts most, as a ratio to the AbsRel of all. A quantity that
knows nothing has correlation 0 and ratio 1; the error itself has 1 and the lowest ratio there is.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch

from dyfn_core import DepthStream, load_model
from dyfn_core.geometry.edges import flying_pixels
from dyfn_core.models.base import image_to_batch
from dyfn_ros.recordings.open import RecordedFrame, open_recording


def ranks(values: np.ndarray) -> np.ndarray:
    """0 .. N-1; equal values in any order."""
    result = np.empty(len(values))
    result[np.argsort(values, kind="stable")] = np.arange(len(values))
    return result


def fit(depth: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The depth with its best scale and shift, by weighted least squares (1 / truth), twice; the
    second time without the worst fifth."""
    keep = np.ones(len(depth), bool)
    for _ in range(2):
        weight = 1 / truth[keep]
        columns = np.stack([depth[keep], np.ones(keep.sum())], axis=1) * weight[:, None]
        scale, shift = np.linalg.lstsq(columns, truth[keep] * weight, rcond=None)[0]
        aligned = scale * depth + shift
        error = np.abs(aligned - truth) / truth
        keep = error <= np.quantile(error, 0.8)
    return aligned


class Candidates:
    """Quantities that should be small where the depth is right; each H x W."""

    def __init__(self) -> None:
        self._before: np.ndarray | None = None

    def __call__(
        self, frame: RecordedFrame, depth: np.ndarray, mask_value: np.ndarray
    ) -> dict[str, np.ndarray]:
        log_depth = np.log(depth)
        before = log_depth if self._before is None else self._before
        first, self._before = self._before is None, log_depth
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        finite = np.isfinite(depth)
        edges = flying_pixels(depth, finite, 0.03)
        distance = cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, 3)
        found = {
            "mask value (inverse)": -mask_value,
            "depth edge nearness": -distance,
            "depth gradient": _gradient(log_depth.astype(np.float32)),
            "flat picture (inverse gradient)": -_gradient(cv2.GaussianBlur(grey, (0, 0), 3)),
            "depth itself": depth,
            "distance from the centre": _radius(*depth.shape),
        }
        if not first:
            found["temporal residual"] = np.abs(log_depth - before)
        return found


def _gradient(values: np.ndarray) -> np.ndarray:
    return np.hypot(cv2.Sobel(values, cv2.CV_32F, 1, 0), cv2.Sobel(values, cv2.CV_32F, 0, 1))


def _radius(height: int, width: int) -> np.ndarray:
    v, u = np.mgrid[:height, :width]
    return np.hypot(u - width / 2, v - height / 2)


def measure(recording: Path, name: str, count: int) -> dict[str, list[tuple[float, float]]]:
    """Per candidate, per frame: correlation and ratio."""
    model = load_model(name)
    stream: DepthStream | None = None
    candidates, rows = Candidates(), defaultdict(list)
    for frame in islice(open_recording(recording).frames(), count):
        stream = stream or DepthStream(model, camera_matrix=frame.camera_matrix)
        state = stream.memory.state
        prediction = stream.push(frame.image)
        batch, _ = image_to_batch(frame.image)
        with torch.inference_mode():
            affine, _ = model.predict_affine(batch, state, None, True)
        depth = prediction.depth.numpy().astype(np.float64)
        found = candidates(frame, depth, affine.mask[0].numpy())
        if frame.depth is None:
            continue
        truth = cv2.resize(frame.depth, depth.shape[::-1], interpolation=cv2.INTER_NEAREST).astype(
            np.float64
        )
        usable = np.isfinite(depth) & np.isfinite(truth) & (truth > 0)
        for values in found.values():
            usable &= np.isfinite(values)
        if usable.sum() < 100:
            continue
        error = np.abs(fit(depth[usable], truth[usable]) - truth[usable]) / truth[usable]
        for key, values in {**found, "the error itself": None}.items():
            order = ranks(error if values is None else values[usable])
            correlation = float(np.corrcoef(order, ranks(error))[0, 1])
            trusted = error[order < len(order) / 2].mean() / error.mean()
            rows[key].append((correlation, float(trusted)))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recording", type=Path, default=Path("bags/demo"))
    parser.add_argument("--model", default="dyfn-mini")
    parser.add_argument("--frames", type=int, default=60)
    options = parser.parse_args()
    rows = measure(options.recording, options.model, options.frames)
    print(f"{'candidate':34} correlation  trusted half  frames")
    for key, values in sorted(rows.items(), key=lambda row: -np.mean([r[0] for r in row[1]])):
        correlation, trusted = np.mean(values, axis=0)
        print(f"{key:34} {correlation:11.3f}  {trusted:12.2f}  {len(values):6}")


if __name__ == "__main__":
    main()
