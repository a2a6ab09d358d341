"""Settings of `dyfn-train adapt`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from dyfn_core.adaptation.defaults import HOLD_BACK, RATE, SEED, STEPS, TEST
from dyfn_core.training.config import LoopConfig


class AdaptConfig(LoopConfig):
    """`dyfn-train adapt`: DyFN, and by option the decoder, on triangulated points.

    Attributes:
        recordings: As they were given.
        base: The model that is adapted.
        decoder: Which part of the decoder learns too.
        decoder_rate: Its learning rate, relative to DyFN's.
        rate: Frames a second that are learned from; points are tracked in all frames.
        hold_back: Share of each recording's time that decides when to stop.
        test: Share at the end of each recording that is neither learned from nor decides.
        clips: Clips of a batch.
        length: Frames of each.
        most_stride: Largest distance of a clip's frames.
        decoded: Frames of a clip that the loss sees.
        frame_weight: Of each frame's own error of shape, beside that of the clip's one scale.
    """

    recordings: tuple[str, ...] = Field(min_length=1)
    base: str = "dyfn-mini"
    decoder: Literal["none", "last", "all"] = "none"
    decoder_rate: float = Field(0.3, gt=0)
    rate: float = Field(RATE, gt=0)
    hold_back: float = Field(HOLD_BACK, gt=0, lt=1)
    test: float = Field(TEST, ge=0, lt=1)
    clips: int = Field(2, ge=1)
    length: int = Field(8, ge=2)
    most_stride: int = Field(3, ge=1)
    decoded: int = Field(4, ge=2)
    frame_weight: float = Field(0.5, ge=0)
    steps: int = Field(STEPS, ge=1)
    seed: int = SEED
    patience: int | None = Field(4, ge=1)
    learning_rate: float = Field(5e-4, gt=0)
    warmup_steps: int = Field(20, ge=0)
    ema_decay: float = Field(0.95, ge=0, lt=1)
    checkpoint_minutes: float = Field(1.0, gt=0)
    validate_every: int = Field(40, ge=1)

    @model_validator(mode="after")
    def _fits(self) -> AdaptConfig:
        if self.decoded > self.length:
            raise ValueError(f"decoded {self.decoded} exceeds length {self.length}")
        return self
