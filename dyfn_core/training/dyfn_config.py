"""What `dyfn-train dyfn` can be told: a method with its own settings, and an objective with its."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from dyfn_core.data.clips import multiples
from dyfn_core.losses.full.objective import Objective
from dyfn_core.models.dyfn import DyFNConfig
from dyfn_core.training.config import RunConfig, StageConfig, Strict
from dyfn_core.training.config_errors import check_fields


class TermsObjective(Strict):
    """The sampled terms, for a base of points.

    Attributes:
        decoded: Frames of the unrolled ones that the losses see.
        windows: Distances of the temporal loss, in frames.
        align_differentiable: Gradients flow through the first frame's alignment; the paper
            detaches it.
        align_first_weight: Of L_align under the first frame's alignment.
        align_all_weight: Of L_align under the alignment of all frames.
        temporal_weight: Of L_temp.
        frame_weight: Of each frame's own error.
        spread_weight: Of the spread of the frames' log scales.
    """

    kind: Literal["terms"] = "terms"
    decoded: int = Field(8, ge=2)
    windows: tuple[int, ...] = Field((1, 2, 4), min_length=1)
    align_differentiable: bool = True
    align_first_weight: float = Field(1.0, ge=0)
    align_all_weight: float = Field(0.5, ge=0)
    temporal_weight: float = Field(0.1, ge=0)
    frame_weight: float = Field(0.2, ge=0)
    spread_weight: float = Field(1.0, ge=0)

    def weights(self) -> dict[str, float]:
        """Weight of each term by its logged name."""
        return {
            "align_first": self.align_first_weight,
            "align_all": self.align_all_weight,
            "temporal": self.temporal_weight,
            "frame": self.frame_weight,
            "spread": self.spread_weight,
        }


class DisparityObjective(Strict):
    """L_ssi and L_temp, for a base of disparity (paper section 4).

    Attributes:
        decoded: Frames of the unrolled ones that the losses see.
        windows: Distances of the temporal loss, in frames.
        ssi_weight: Of L_ssi.
        temporal_weight: Of L_temp.
        align_first_weight: Of L_align in disparity space, under the first frame's alignment.
    """

    kind: Literal["disparity"] = "disparity"
    decoded: int = Field(8, ge=2)
    windows: tuple[int, ...] = Field((1, 2, 4), min_length=1)
    ssi_weight: float = Field(1.0, ge=0)
    temporal_weight: float = Field(0.1, ge=0)
    align_first_weight: float = Field(0.0, ge=0)

    def weights(self) -> dict[str, float]:
        """Weight of each term by its logged name."""
        return {
            "ssi": self.ssi_weight,
            "temporal": self.temporal_weight,
            "align_first": self.align_first_weight,
        }


class PaperObjective(BaseModel):
    """The paper's whole objective, for a base of points; every unrolled frame is decoded.

    The other settings are the fields of losses.full.objective.Objective.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    kind: Literal["paper"] = "paper"

    @model_validator(mode="after")
    def _describes_an_objective(self) -> PaperObjective:
        check_fields(self.model_extra or {}, Objective)
        return self

    def objective(self) -> Objective:
        """The objective that the settings describe."""
        return Objective.from_dict(self.model_extra or {})


AnyObjective = TermsObjective | DisparityObjective | PaperObjective


class UnrolledMethod(Strict):
    """As in the paper: DyFN is unrolled over clips of latents and decoded.

    Attributes:
        cache: Folder of encoded clips; default: OUT/latents.
        cache_draws: Batches of `stages[0].batch` clips in it; 0 for no cache: every step then
            encodes clips of its own.
        cache_seed: Of its draws; default: `seed`.
        cache_length: Frames of a cached clip and of a clip of validation.
        strides: Least and greatest distance of a clip's frames.
        clips: Clips of a training batch.
        length: Frames unrolled.
        objective: What is minimised.
    """

    kind: Literal["unrolled"]
    cache: Path | None = None
    cache_draws: int = Field(200, ge=0)
    cache_seed: int | None = None
    cache_length: int = Field(32, ge=2)
    strides: tuple[int, int] = (3, 8)
    clips: int = Field(4, ge=1)
    length: int = Field(16, ge=2)
    objective: Annotated[AnyObjective, Field(discriminator="kind")] = TermsObjective.model_validate(
        {}
    )

    @model_validator(mode="after")
    def _fits(self) -> UnrolledMethod:
        _check_lengths(self.length, self.cache_length, self.strides)
        unused = [name for name in ("cache", "cache_seed") if getattr(self, name) is not None]
        if unused and not self.cache_draws:
            raise ValueError(f"{' and '.join(unused)} without effect: cache_draws is 0")
        return self


class LinearizedMethod(Strict):
    """DyFN's recurrence from the base's own scale errors, with the decoder linearized.

    Attributes:
        cache: Folder of the inputs of the recurrence; default: OUT/gru_inputs.
        gru_input_draws: Batches of `stages[0].batch` clips in it.
        cache_seed: Of its draws; default: `seed`.
        cache_length: Frames of a cached clip and of a clip of validation.
        strides: Least and greatest distance of a cached clip's frames.
        sub_strides: Least and greatest distance of a training clip's frames in a cached clip.
        clips: Clips of a training batch.
        length: Frames of each.
        noise: Added to the inputs, in units of their deviation.
        spread_weight: Of the spread of the scale errors.
        video_weight: Of the video protocol's error.
        size_weight: Of the size of the scale errors.
        change_weight: Of the size of the corrections.
    """

    kind: Literal["linearized"]
    cache: Path | None = None
    gru_input_draws: int = Field(400, ge=1)
    cache_seed: int | None = None
    cache_length: int = Field(48, ge=2)
    strides: tuple[int, int] = (1, 1)
    sub_strides: tuple[int, int] = (1, 3)
    clips: int = Field(12, ge=1)
    length: int = Field(16, ge=2)
    noise: float = Field(0.15, ge=0)
    spread_weight: float = Field(1.0, ge=0)
    video_weight: float = Field(1.0, ge=0)
    size_weight: float = Field(0.2, ge=0)
    change_weight: float = Field(0.02, ge=0)

    @model_validator(mode="after")
    def _fits(self) -> LinearizedMethod:
        _check_lengths(self.length, self.cache_length, self.strides)
        if not 1 <= self.sub_strides[0] <= self.sub_strides[1]:
            raise ValueError(f"sub_strides must rise from 1 or more, got {self.sub_strides}")
        if (self.length - 1) * self.sub_strides[0] >= self.cache_length:
            raise ValueError(
                f"{self.length} frames {self.sub_strides[0]} apart do not fit into a cached clip "
                f"of {self.cache_length}"
            )
        return self

    def weights(self) -> dict[str, float]:
        """Weight of each term by its logged name."""
        return {
            "spread": self.spread_weight,
            "video": self.video_weight,
            "size": self.size_weight,
            "change": self.change_weight,
        }


Method = UnrolledMethod | LinearizedMethod


class DyFNRunConfig(RunConfig):
    """`dyfn-train dyfn`: DyFN on a frozen base.

    Attributes:
        base: A checkpoint of any model.
        dyfn: Fields of DyFNConfig.
        warm_start: Go on from the base's own DyFN instead of a fresh one.
        validation_clips: Rendered clips to validate on.
        validation_stride: Every N-th frame of `validation_rgbd` is validated on.
        method: How DyFN is trained.
    """

    kinds: tuple[str, ...] = ("clip",)
    base: Path
    dyfn: dict[str, Any] = Field(default_factory=dict)
    warm_start: bool = False
    validation_clips: int = Field(8, ge=1)
    validation_stride: int = Field(4, ge=1)
    method: Annotated[Method, Field(discriminator="kind")]

    @field_validator("dyfn")
    @classmethod
    def _describes_a_dyfn(cls, value: dict[str, Any]) -> dict[str, Any]:
        return check_fields(value, DyFNConfig)

    @model_validator(mode="after")
    def _fits(self) -> DyFNRunConfig:
        if self.warm_start and self.dyfn:
            raise ValueError("warm_start keeps the base's DyFN: remove the `dyfn` settings")
        objective = getattr(self.method, "objective", None)
        if isinstance(objective, PaperObjective):
            self._check_levels(objective.objective())
        return self

    def _check_levels(self, objective: Objective) -> None:
        for height, width in {size for stage in self.stages for size in stage_sizes(stage)}:
            try:
                objective.check_size((height // 2, width // 2))
            except ValueError as error:
                raise ValueError(
                    f"stages.sizes [{height}, {width}]: the losses are computed at half of it. "
                    f"{error}. Or leave that level out of method.objective.levels"
                ) from error


def stage_sizes(stage: StageConfig) -> tuple[tuple[int, int], ...]:
    """The sizes (H, W) of a stage; of ranges, the smallest and largest at both ends of aspect."""
    if stage.area is None or stage.aspect is None:
        return stage.sizes
    return tuple(multiples(area, aspect) for area in stage.area for aspect in stage.aspect)


def _check_lengths(length: int, cache_length: int, strides: tuple[int, int]) -> None:
    if length > cache_length:
        raise ValueError(f"length {length} exceeds cache_length {cache_length}")
    if not 1 <= strides[0] <= strides[1]:
        raise ValueError(f"strides must rise from 1 or more, got {strides}")
