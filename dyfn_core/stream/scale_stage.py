"""What the stages that give metres have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dyfn_core.metric.references import Reference
from dyfn_core.metric.scale import ScaleInForce
from dyfn_core.prediction import Prediction
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.stages import StreamStage


class ScaleStage(StreamStage, ABC):
    """A stage that gives metres, and what it says of them.

    Attributes:
        scale: What the depth of the last frame means.
    """

    called = "scale"  # in front of a problem
    scale: ScaleInForce

    def __init__(self, options: Callable[[], StreamOptions]) -> None:
        """options: Asked for at each frame; only the live ones may change."""
        self._options = options
        self._anew = False  # a calibration was asked for since the last frame

    @property
    def measures(self) -> bool:
        """Whether its scale comes from measurements."""
        return True

    def request_calibration(self) -> None:
        """Measure the scale anew from the next frame on; any thread."""
        self._anew = True

    @property
    @abstractmethod
    def metres_per_unit(self) -> float | None:
        """Metres in the unit that the whole stream keeps; None before they are known."""

    @property
    @abstractmethod
    def unused(self) -> Counter[str]:
        """How often something was not used, by reason."""

    @abstractmethod
    def add_reference(self, stamp: float, reference: Reference) -> None:
        """A measurement, any thread."""

    @property
    def _keeps(self) -> bool:
        """Whether a measured scale stays in force over a reset."""
        return self._options().after_reset == "keep"

    def _without_metres(self, prediction: Prediction[np.ndarray]) -> Prediction[np.ndarray]:
        """What is given while no metres are known: relative depth, or none."""
        if self._options().until_metric != "withhold":
            return prediction
        return replace(
            prediction, mask=np.zeros_like(prediction.mask), withheld=prediction.mask.copy()
        )

    def problems(self) -> list[str]:
        """See StreamStage."""
        return [f"{self.called}: {self.scale.warning}"] if self.scale.warning else []

    def report(self) -> dict[str, str]:
        """See StreamStage."""
        values = {f"scale: {key}": value for key, value in self.scale.described().items()}
        unused = sorted(self.unused.items())
        values.update({f"scale: not used, {reason}": str(n) for reason, n in unused})
        return values
