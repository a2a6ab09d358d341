"""What a training run can be told, as YAML files and key=value overrides."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    field_validator,
    model_validator,
)

from dyfn_core.data.datasets import AUTO, RENDERED, data_kind
from dyfn_core.data.frames import DataError
from dyfn_core.data.pool import DataSpec
from dyfn_core.data.rendered import SPLITS
from dyfn_core.losses.full.objective import Objective
from dyfn_core.models.dyfn import DyFNConfig
from dyfn_core.models.mini import MiniConfig
from dyfn_core.training.config_errors import check_fields, describe

Settings = TypeVar("Settings", bound="RunConfig")


class ConfigError(ValueError):
    """A training config that cannot be used; the message names file, key and expectation."""


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class StageConfig(Strict):
    """From step `from_step` on: batches of `batch` at one of `sizes` (H, W)."""

    from_step: int = Field(ge=0)
    sizes: tuple[tuple[int, int], ...] = Field(min_length=1)
    batch: int = Field(ge=1)

    @field_validator("sizes")
    @classmethod
    def _multiples(cls, sizes: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
        for size in sizes:
            if any(side <= 0 or side % 32 for side in size):
                raise ValueError(f"size {size} must be positive multiples of 32")
        return sizes


class DataConfig(BaseModel):
    """One data set: root, kind, weight, split and cuts as in DataSpec; other keys are the options
    of the kind. A path alone stands for its root."""

    model_config = ConfigDict(extra="allow", frozen=True)

    root: Path
    kind: str = AUTO
    weight: float | None = Field(None, gt=0)
    split: str | None = None
    cuts: tuple[int | str, ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _path_alone(cls, value: Any) -> Any:
        return {"root": value} if isinstance(value, (str, Path)) else value

    @model_validator(mode="after")
    def _options_of_kind(self) -> DataConfig:
        if self.split not in (None, *SPLITS):
            raise ValueError(f"split must be one of {SPLITS}, got {self.split!r}")
        try:
            known = {} if self.kind in (AUTO, RENDERED) else data_kind(self.kind).options()
        except DataError as error:
            raise ValueError(str(error)) from error
        for name, value in (self.model_extra or {}).items():
            if name not in known:
                raise ValueError(self._unknown(name, [*known, *type(self).model_fields]))
            try:
                self.model_extra[name] = TypeAdapter(known[name][0]).validate_python(value)  # type: ignore[index]
            except ValidationError as error:
                raise ValueError(f"{name}: {error.errors()[0]['msg']}, got {value!r}") from error
        return self

    def _unknown(self, name: str, names: list[str]) -> str:
        near = difflib.get_close_matches(name, names, n=1)
        hint = f", did you mean {near[0]!r}?" if near else ""
        if self.kind == AUTO:
            hint = hint or ", options need the `kind` to be named"
        return f"unknown key {name!r} of kind {self.kind!r}{hint}"

    def spec(self) -> DataSpec:
        """As the loaders want it."""
        options = tuple(sorted((self.model_extra or {}).items()))
        return DataSpec(self.root, self.kind, self.weight, self.split, self.cuts, options)


class RunConfig(Strict):
    """What every run has: data, schedule, bookkeeping.

    data: roots of data sets, or mappings with their root, kind and weight (DataConfig). kinds: of
    rendered folders. steps: length of the schedule. hours: the schedule ends no
    later than after so much training time, whatever the step. validation_rgbd: a recording with
    rgb/, depth/ and K.txt to validate on too. device: "auto" takes the GPU that accelerate gives
    this process, if any. mixed_precision: of the network; losses are always float32. parts: a
    batch is computed in so many equal parts, shared out among the processes (default: one each).
    most_bad_steps: so many in a row may be skipped for a loss or gradient that is not finite.
    """

    data: tuple[DataConfig, ...] = Field(min_length=1)
    kinds: tuple[str, ...] = ("frames", "clip")
    stages: tuple[StageConfig, ...] = Field(min_length=1)
    steps: int = Field(ge=1)
    hours: float | None = Field(None, gt=0)
    seed: int = 0
    threads: int = Field(2, ge=1)
    device: Literal["auto", "cpu"] = "auto"
    mixed_precision: Literal["no", "bf16", "fp16"] = "no"
    parts: int | None = Field(None, ge=1)
    learning_rate: float = Field(1e-3, gt=0)
    weight_decay: float = Field(0.01, ge=0)
    warmup_steps: int = Field(200, ge=0)
    clip_norm: float = Field(1.0, gt=0)
    ema_decay: float = Field(0.999, ge=0, lt=1)
    most_bad_steps: int = Field(20, ge=0)
    augment_strength: float = Field(1.0, ge=0, le=1)
    smallest_view: float = Field(0.5, gt=0, le=1)
    checkpoint_minutes: float = Field(4.0, gt=0)
    log_every: int = Field(20, ge=1)
    picture_every: int = Field(500, ge=1)
    validate_every: int = Field(1000, ge=1)
    validation_frames: int = Field(48, ge=1)
    validation_rgbd: Path | None = None

    @field_validator("stages")
    @classmethod
    def _in_order(cls, stages: tuple[StageConfig, ...]) -> tuple[StageConfig, ...]:
        starts = [stage.from_step for stage in stages]
        if starts[0] != 0 or starts != sorted(set(starts)):
            raise ValueError(f"stages must start at step 0 and rise, got from_step {starts}")
        return stages


class BaseRunConfig(RunConfig):
    """`dyfn-train base`: the small model's encoder and head.

    encoder_rate: the encoder's learning rate relative to the head's. frozen_blocks: the stem and
    so many encoder blocks keep their ImageNet weights. frozen_depthwise: so do all the encoder's
    depthwise filters. model: fields of MiniConfig. initial: a
    checkpoint to start from instead of ImageNet weights.
    """

    model: dict[str, Any] = Field(default_factory=dict)
    initial: Path | None = None
    encoder_rate: float = Field(0.1, ge=0)
    frozen_blocks: int = Field(3, ge=0, le=16)
    frozen_depthwise: bool = True
    local_weight: float = Field(1.0, ge=0)
    normal_weight: float = Field(0.05, ge=0)
    normal_stride: int = Field(4, ge=1)
    mask_weight: float = Field(1.0, ge=0)
    scale_weight: float = Field(0.3, ge=0)
    gradient_weight: float = Field(0.5, ge=0)
    balls: tuple[int, int] = (8, 12)

    @field_validator("model")
    @classmethod
    def _describes_a_model(cls, value: dict[str, Any]) -> dict[str, Any]:
        return check_fields(value, MiniConfig)


class StabilizerRunConfig(RunConfig):
    """`dyfn-train stabilizer`: DyFN on a frozen base.

    base: a checkpoint of any model. stabilizer: fields of DyFNConfig. warm_start: go on from
    the base's own DyFN instead of a fresh one. cache: folder of encoded clips (default:
    OUT/latents); cache_draws: batches of `stages[0].batch` clips in it, 0 for no cache: every
    step then encodes clips of its own; cache_seed: of its draws (default: `seed`);
    cache_length: frames of a cached clip, `strides` apart. clips: clips of a training batch;
    length: frames unrolled; decoded: frames of them that the losses see. windows: of the temporal
    loss. The four weights: L_align from the first frame and from all, L_temp, and each frame's
    own error. align_differentiable: gradients flow through the first frame's alignment (the
    paper detaches it). A base of disparity is trained with L_ssi and L_temp as in the paper:
    ssi_weight, temporal_weight, and disparity_align_weight for first-frame alignment in disparity
    space. objective: fields of losses.full.objective.Objective; given, it replaces the terms above
    for a base of points, and every unrolled frame is decoded. validation_stride: every
    so-many-th frame of the recording.
    """

    base: Path
    kinds: tuple[str, ...] = ("clip",)
    stabilizer: dict[str, Any] = Field(default_factory=dict)
    warm_start: bool = False
    cache: Path | None = None
    cache_draws: int = Field(200, ge=0)
    cache_seed: int | None = None
    cache_length: int = Field(32, ge=2)
    strides: tuple[int, int] = (3, 8)
    clips: int = Field(4, ge=1)
    length: int = Field(16, ge=2)
    decoded: int = Field(8, ge=2)
    windows: tuple[int, ...] = (1, 2, 4)
    align_differentiable: bool = True
    align_first_weight: float = Field(1.0, ge=0)
    align_all_weight: float = Field(0.5, ge=0)
    temporal_weight: float = Field(0.1, ge=0)
    frame_weight: float = Field(0.2, ge=0)
    spread_weight: float = Field(1.0, ge=0)
    ssi_weight: float = Field(1.0, ge=0)
    disparity_align_weight: float = Field(0.0, ge=0)
    objective: dict[str, Any] | None = None
    validation_clips: int = Field(8, ge=1)
    validation_stride: int = Field(4, ge=1)

    @field_validator("stabilizer")
    @classmethod
    def _describes_a_stabilizer(cls, value: dict[str, Any]) -> dict[str, Any]:
        return check_fields(value, DyFNConfig)

    @field_validator("objective")
    @classmethod
    def _describes_an_objective(cls, value: dict[str, Any] | None) -> dict[str, Any] | None:
        return None if value is None else check_fields(value, Objective)

    @model_validator(mode="after")
    def _fits(self) -> StabilizerRunConfig:
        if self.length > self.cache_length:
            raise ValueError(f"length {self.length} exceeds cache_length {self.cache_length}")
        if self.warm_start and self.stabilizer:
            raise ValueError("warm_start keeps the base's DyFN: remove the `stabilizer` settings")
        if not 1 <= self.strides[0] <= self.strides[1]:
            raise ValueError(f"strides must rise from 1 or more, got {self.strides}")
        return self

    def loss_weights(self) -> dict[str, float]:
        """Weight of each term by its logged name."""
        return {
            "align_first": self.align_first_weight,
            "align_all": self.align_all_weight,
            "temporal": self.temporal_weight,
            "frame": self.frame_weight,
            "spread": self.spread_weight,
        }

    def disparity_weights(self) -> dict[str, float]:
        """The same for a base of disparity."""
        return {
            "ssi": self.ssi_weight,
            "temporal": self.temporal_weight,
            "align_first": self.disparity_align_weight,
        }


class ScaleRunConfig(StabilizerRunConfig):
    """`dyfn-train scale`: DyFN's recurrence from the scale errors of the base's own frames.

    summary_draws: clips of `cache_length` frames that are summarised, once, in `cache`; a clip of
    training is `length` of its frames, sub_strides apart. spread_weight, video_weight, size_weight,
    change_weight: of the spread of the scale errors, of the video protocol's error, of the errors'
    size and of the corrections'. noise: added to the summaries, in units of their deviation.
    """

    cache_draws: int = Field(0, ge=0, le=0)
    summary_draws: int = Field(400, ge=1)
    cache_length: int = Field(48, ge=2)
    strides: tuple[int, int] = (1, 1)
    sub_strides: tuple[int, int] = (1, 3)
    clips: int = Field(12, ge=1)
    video_weight: float = Field(1.0, ge=0)
    size_weight: float = Field(0.2, ge=0)
    change_weight: float = Field(0.02, ge=0)
    noise: float = Field(0.15, ge=0)


def read_config(path: Path, kind: type[Settings], overrides: list[str]) -> Settings:
    """The settings in a YAML file with `key=value` (or `key.sub=value`) overrides on top.

    Relative paths in it are relative to the working directory. Raises ConfigError.
    """
    try:
        values = yaml.safe_load(path.read_text())
    except FileNotFoundError as error:
        raise ConfigError(f"no training config at {path}") from error
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(
            f"{path} is no readable YAML file of settings (data are given with --data): {error}"
        ) from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected a mapping of settings")
    for override in overrides:
        _override(values, override)
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        problems = "\n  ".join(describe(error, kind))
        raise ConfigError(f"{path}:\n  {problems}") from error


def _override(values: dict[str, Any], override: str) -> None:
    key, found, text = override.partition("=")
    if not found or not key:
        raise ConfigError(f"--set {override!r}: expected key=value")
    *parents, last = key.split(".")
    for parent in parents:
        values = values.setdefault(parent, {})
        if not isinstance(values, dict):
            raise ConfigError(f"--set {override!r}: {parent} holds no settings of its own")
    try:
        values[last] = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {override!r}: the value is no YAML: {error}") from error
