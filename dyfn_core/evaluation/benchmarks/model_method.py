"""A model scored as it runs live, through DepthStream, with the controls of its latent."""

from __future__ import annotations

import time
from array import array
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from dyfn_core.data.frames import DataError
from dyfn_core.evaluation.benchmarks.metres import MetresStream
from dyfn_core.evaluation.benchmarks.predictions import Predict
from dyfn_core.evaluation.benchmarks.sets.base import BenchmarkFrame, BenchmarkSequence
from dyfn_core.models.base import GeometryModel, image_to_batch
from dyfn_core.models.controls import decode_with, latent_controls, stabilized_by
from dyfn_core.models.dyfn import DyFN
from dyfn_core.prediction import DISPARITY, Prediction
from dyfn_core.quantities import scored_quantity
from dyfn_core.stream.depth_stream import DepthStream

BASE = ", base"  # ends the name of the variant without DyFN


class ModelMethod:
    """predictions.Method of a model: with DyFN, without, and with the statistics controls.

    stabilize: False leaves the DyFN variant out. controls: False leaves the moving average and the
    frozen statistics out. num_tokens: None for the model's default. known_camera: tell the stream
    the benchmark's intrinsics; otherwise, as in the paper, it finds the focal length itself.
    metres_from: some of metres.METRES: the first variant again, in metres by these.
    The image is encoded once for all variants; each has a DepthStream of its own, and the encoding
    counts in the time of each.
    """

    def __init__(
        self,
        name: str,
        model: GeometryModel,
        *,
        stabilize: bool = True,
        controls: bool = True,
        num_tokens: int | None = None,
        known_camera: bool = False,
        metres_from: Sequence[str] = (),
    ) -> None:
        if metres_from and model.quantity == DISPARITY:
            raise DataError(f"{name} predicts disparity: no metres can be given to it")
        self.model = model
        self.num_tokens = num_tokens
        self.known_camera = known_camera
        self._stabilizers: dict[str, DyFN | None] = {}
        if stabilize and model.stabilizer is not None:
            self._stabilizers[f"{name} + DyFN"] = model.stabilizer
        self._stabilizers[name + BASE] = None
        if controls:
            found = latent_controls(model)
            self._stabilizers |= {f"control: {kind}": found[kind] for kind in found}
        self._first = next(iter(self._stabilizers))
        self._metres = {f"{self._first} + {source}": source for source in metres_from}
        self._seconds = {name: array("d") for name in self.variants}

    @property
    def quantity(self) -> str:
        """See predictions.Method."""
        return scored_quantity(self.model.quantity)

    @property
    def variants(self) -> tuple[str, ...]:
        """See predictions.Method."""
        return (*self._stabilizers, *self._metres)

    @property
    def in_metres(self) -> tuple[str, ...]:
        """See predictions.Method."""
        return tuple(self._metres)

    @property
    def seconds(self) -> Mapping[str, Sequence[float]]:
        """See predictions.Method."""
        return self._seconds

    def open(self, sequence: BenchmarkSequence) -> Predict:
        """See predictions.Method; every sequence begins with fresh streams."""
        streams: dict[str, DepthStream] = {}
        metres = {name: MetresStream(kind, sequence.name) for name, kind in self._metres.items()}

        @torch.inference_mode()
        def predict(index: int, frame: BenchmarkFrame) -> dict[str, np.ndarray]:
            if not streams:
                streams.update(self._streams(frame))
            start = time.perf_counter()
            image, _ = image_to_batch(frame.image, self.model.device)
            latent = self.model.encode(image, self.num_tokens)
            if self.model.device.type == "cuda":
                torch.cuda.synchronize(self.model.device)  # or the first variant would wait for it
            encoding = time.perf_counter() - start
            found = {}
            for name, stream in streams.items():
                start = time.perf_counter()
                stabilizer, state = self._stabilizers[name], stream.memory.state
                affine, state = decode_with(self.model, stabilizer, latent, state)
                found[name] = as_array(stream.finish(affine, state, float(index)))
                self._seconds[name].append(encoding + time.perf_counter() - start)
            for name, metric in metres.items():
                start = time.perf_counter()
                found[name] = metric.push(index, frame, found[self._first])
                seconds = self._seconds[self._first][-1] + time.perf_counter() - start
                self._seconds[name].append(seconds)
            return found

        return predict

    def _streams(self, frame: BenchmarkFrame) -> dict[str, DepthStream]:
        matrix = frame.camera_matrix if self.known_camera else None
        made = {}
        for name, stabilizer in self._stabilizers.items():
            with stabilized_by(self.model, stabilizer):
                made[name] = DepthStream(self.model, matrix, num_tokens=self.num_tokens)
        return made


def as_array(prediction: Prediction) -> np.ndarray:
    """H x W float32: depth, or disparity of a disparity model; NaN where the mask is False."""
    values = prediction.depth
    if prediction.quantity == DISPARITY and prediction.disparity is not None:
        values = prediction.disparity
    array = values.float().cpu().numpy()
    return np.where(prediction.mask.cpu().numpy(), array, np.float32(np.nan))
