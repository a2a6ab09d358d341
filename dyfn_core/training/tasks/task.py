"""What a run trains, as the trainer sees it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from torch import Tensor

from dyfn_core.models.base import GeometryModel


class Task(ABC):
    """What is trained: the model, its parameter groups, its loss, and how it is judged."""

    model: GeometryModel

    @cached_property
    def unreadable(self) -> Counter[str]:
        """What this process drew but could not read: message -> how often."""
        return Counter()

    @abstractmethod
    def groups(self) -> list[dict[str, Any]]:
        """Parameter groups for AdamW, each with its own "lr"."""

    @abstractmethod
    def batches(self, start: int, part: int = 0, parts: int = 1) -> Iterator[Any]:
        """One part of the batches from step `start` on; a dataclass of tensors each.

        Raises ConfigError when the batch cannot be split into that number of equal parts.
        """

    @abstractmethod
    def images(self, batch: Any) -> int:
        """How many images a part of a batch holds."""

    @abstractmethod
    def loss(self, batch: Any) -> tuple[Tensor, dict[str, float]]:
        """The loss to minimise, a mean over the part, and values to log."""

    @abstractmethod
    def validate(self) -> dict[str, float]:
        """Scores; "score" (lower is better) chooses the best model."""

    @abstractmethod
    def picture(self, batch: Any) -> np.ndarray:
        """A strip of images, H x W x 3 uint8 RGB."""

    def export_model(self) -> GeometryModel:
        """The model to write; called while the averaged parameters are in place."""
        return self.model
