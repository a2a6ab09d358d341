"""What a lower `num_tokens` saves, and what it costs.

    python benchmarks/tokens.py [--model dyfn-mini] [--tokens 192 128 96 64 48] [--frames 60]

Streams of all token counts take the frames of the recording in turns. Their time is that of the
processor, on one thread, so that a busy machine changes it little; the median over the frames is
printed as a share of the first stream's. AbsRel is that of the image protocol (each frame aligned)
and of the video protocol (aligned once).
"""

from __future__ import annotations

import argparse
import statistics
import time
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch

from dyfn_core import DepthStream, load_model
from dyfn_core.models.base import GeometryModel
from dyfn_core.scoring.protocols import SequenceScorer
from dyfn_ros.recordings.open import RecordedFrame, open_recording

WARM = 2  # frames of each stream that are not timed


class TimedStream:
    """A stream with DyFN, its processor time and its scores."""

    def __init__(
        self, model: GeometryModel, num_tokens: int, camera_matrix: np.ndarray | None
    ) -> None:
        self._stream = DepthStream(model, camera_matrix, num_tokens=num_tokens)
        self._scorer = SequenceScorer(quantity=model.quantity)
        self._seconds: list[float] = []

    def push(self, frame: RecordedFrame) -> None:
        start = time.process_time()
        prediction = self._stream.push(frame.image)
        self._seconds.append(time.process_time() - start)
        if frame.depth is not None:
            depth = prediction.depth.cpu().numpy().copy()
            depth[~prediction.mask.cpu().numpy()] = np.nan
            size = frame.depth.shape[::-1]
            self._scorer.push(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), frame.depth)

    @property
    def milliseconds(self) -> float:
        return 1e3 * statistics.median(self._seconds[WARM:])

    def abs_rel(self) -> tuple[float, float]:
        """Image protocol, video protocol."""
        image, video = self._scorer.image(), self._scorer.video()
        if image is None or video is None:
            raise SystemExit("the recording has no true depth")
        return image.metrics["abs_rel"], video.metrics["abs_rel"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="dyfn-mini")
    parser.add_argument("--recording", type=Path, default=Path("bags/demo"))
    parser.add_argument("--tokens", type=int, nargs="+", default=[192, 128, 96, 64, 48])
    parser.add_argument("--frames", type=int, default=60)
    options = parser.parse_args()
    torch.set_num_threads(1)
    model = load_model(options.model)
    frames = list(islice(open_recording(options.recording).frames(), options.frames))
    matrix = frames[0].camera_matrix
    streams = {tokens: TimedStream(model, tokens, matrix) for tokens in options.tokens}
    for frame in frames:
        for stream in streams.values():
            stream.push(frame)
    first = next(iter(streams.values())).milliseconds
    print("tokens  processor time  AbsRel, image protocol  AbsRel, video protocol")
    for tokens, stream in streams.items():
        image, video = stream.abs_rel()
        share = stream.milliseconds / first
        print(f"{tokens:6d}  {share:14.2f}  {image:22.3f}  {video:22.3f}")


if __name__ == "__main__":
    main()
