"""What a training run can be told, as YAML files and key=value overrides."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Mapping, Sequence
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
from dyfn_core.models.mini import MiniConfig
from dyfn_core.training.config_errors import check_fields, describe

Settings = TypeVar("Settings", bound="LoopConfig")

# What config files were called before -> what they are called.
FORMER_NAMES = {
    "train_scale_mini.yaml": "train_dyfn_mini.yaml",
    "train_stabilizer_mini.yaml": "train_dyfn_unrolled_mini.yaml",
}
logger = logging.getLogger(__name__)


class ConfigError(ValueError):
    """A training config that cannot be used; the message names file, key and expectation."""


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class StageConfig(Strict):
    """From step `from_step` on: batches of `batch` at one of `sizes` (H, W), or at a size drawn
    from `area` (pixels, least and greatest) and `aspect` (width / height).

    Attributes:
        tokens: Least and greatest number of tokens that a vision transformer divides an image
            into; default: as many as the image has cells.
    """

    from_step: int = Field(ge=0)
    sizes: tuple[tuple[int, int], ...] = ()
    batch: int = Field(ge=1)
    area: tuple[int, int] | None = None
    aspect: tuple[float, float] | None = None
    tokens: tuple[int, int] | None = None

    @model_validator(mode="after")
    def _has_sizes(self) -> StageConfig:
        ranges = self.area is not None
        if (self.aspect is not None) != ranges or bool(self.sizes) == ranges:
            raise ValueError("a stage has either `sizes`, or `area` and `aspect`")
        for name in ("area", "aspect", "tokens"):
            given = getattr(self, name)
            if given is not None and not 0 < given[0] <= given[1]:
                raise ValueError(f"{name} must rise from more than 0, got {list(given)}")
        return self

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


class LoopConfig(Strict):
    """What the loop of every run needs: schedule, optimizer, bookkeeping.

    Attributes:
        steps: Length of the schedule.
        hours: The schedule ends no later than after this much training time, whatever the step.
        patience: The run ends after that many validations in a row without a new best; default:
            it goes on.
        seed: Of all random draws.
        threads: Threads of a process.
        device: "auto" takes the GPU that accelerate gives this process, if any.
        mixed_precision: Of the network; losses are always float32.
        parts: A batch is computed in that many equal parts, shared out among the processes;
            default: one for each process.
        learning_rate: Highest rate of the schedule.
        schedule: "cosine" falls to 1% at the end; "halving" is constant for `constant_steps` and
            is then halved every `halve_every` steps, as in the released training.
        constant_steps: See `schedule`.
        halve_every: See `schedule`.
        weight_decay: Of AdamW.
        warmup_steps: Steps in which the rate rises.
        clip_norm: Largest norm of the gradient.
        ema_decay: Of the moving average of the parameters, which is what a run exports.
        most_bad_steps: Steps in a row that may be skipped for a loss or gradient that is not
            finite.
        checkpoint_minutes: Time between checkpoints.
        log_every: Steps between lines of the log.
        picture_every: Steps between pictures.
        validate_every: Steps between validations.
    """

    steps: int = Field(ge=1)
    hours: float | None = Field(None, gt=0)
    patience: int | None = Field(None, ge=1)
    seed: int = 0
    threads: int = Field(2, ge=1)
    device: Literal["auto", "cpu"] = "auto"
    mixed_precision: Literal["no", "bf16", "fp16"] = "no"
    parts: int | None = Field(None, ge=1)
    learning_rate: float = Field(1e-3, gt=0)
    schedule: Literal["cosine", "halving"] = "cosine"
    constant_steps: int = Field(1000, ge=0)
    halve_every: int = Field(5000, ge=1)
    weight_decay: float = Field(0.01, ge=0)
    warmup_steps: int = Field(200, ge=0)
    clip_norm: float = Field(1.0, gt=0)
    ema_decay: float = Field(0.999, ge=0, lt=1)
    most_bad_steps: int = Field(20, ge=0)
    checkpoint_minutes: float = Field(4.0, gt=0)
    log_every: int = Field(20, ge=1)
    picture_every: int = Field(500, ge=1)
    validate_every: int = Field(1000, ge=1)


class RunConfig(LoopConfig):
    """A run on data sets.

    Attributes:
        data: Roots of data sets, or mappings with their root, kind and weight (DataConfig).
        kinds: Kinds of rendered folders.
        stages: Sizes of batches and images, from a step on.
        augment_strength: Of the changes of colour, blur and noise; 0 is none, 1 the full range.
        smallest_view: Smallest side of a crop, relative to the largest that fits into the view.
        fov: Least and greatest horizontal field of view of a crop, degrees; default: no bound.
        depth_clamp: Depth is at most that many times the depth that 1% of the pixels are nearer
            than; default: no bound.
        loader_workers: Processes that read and augment clips; the clips are the same with any
            number of them.
        validation_rgbd: A recording with rgb/, depth/ and K.txt to validate on too.
    """

    data: tuple[DataConfig, ...] = Field(min_length=1)
    kinds: tuple[str, ...] = ("frames", "clip")
    stages: tuple[StageConfig, ...] = Field(min_length=1)
    augment_strength: float = Field(1.0, ge=0, le=1)
    smallest_view: float = Field(0.5, gt=0, le=1)
    fov: tuple[float, float] | None = None
    depth_clamp: float | None = Field(None, gt=1)
    loader_workers: int = Field(1, ge=1)
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

    Attributes:
        model: Fields of MiniConfig.
        initial: A checkpoint to start from instead of ImageNet weights.
        encoder_rate: The encoder's learning rate relative to the head's.
        frozen_blocks: The stem and this many encoder blocks keep their ImageNet weights.
        frozen_depthwise: So do all the encoder's depthwise filters.
        validation_frames: Rendered frames to validate on.
        local_weight: Of L_local.
        normal_weight: Of L_normal.
        normal_stride: Distance of the neighbours that normals are made of, in pixels.
        mask_weight: Of L_mask.
        scale_weight: Of the pull towards the true, focal-normalised scale.
        gradient_weight: Of the differences of the log depth error between neighbours.
        balls: Balls of L_local a frame, at alpha 1/4 and 1/16.
    """

    model: dict[str, Any] = Field(default_factory=dict)
    initial: Path | None = None
    encoder_rate: float = Field(0.1, ge=0)
    frozen_blocks: int = Field(3, ge=0, le=16)
    frozen_depthwise: bool = True
    validation_frames: int = Field(48, ge=1)
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


def read_config(path: Path, kind: type[Settings], overrides: Sequence[str]) -> Settings:
    """Read the settings of a run.

    Relative paths in them are relative to the working directory.

    Args:
        path: YAML file, or the name of a shipped one (`find_config`).
        kind: What the settings are of.
        overrides: `key=value` or `key.sub=value`, put on top of the file's.

    Returns:
        The settings.

    Raises:
        ConfigError: For what cannot be used; names file, key and what was expected.
    """
    return settings_of(read_values(path, overrides), kind, path)


def read_values(path: Path, overrides: Sequence[str]) -> dict[str, Any]:
    """Read a YAML file of settings, unchecked; as read_config otherwise."""
    path = find_config(path)
    try:
        values = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(
            f"{path} is no readable YAML file of settings (data are given with --data): {error}"
        ) from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected a mapping of settings")
    for text in overrides:
        override(values, text)
    return values


def settings_of(values: Mapping[str, Any], kind: type[Settings], source: Path) -> Settings:
    """Check settings. source: the file they are from, for messages. Raises ConfigError."""
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        problems = "\n  ".join(describe(error, kind, values))
        raise ConfigError(f"{source}:\n  {problems}") from error


def find_config(path: Path) -> Path:
    """Find a config file from any working directory.

    Args:
        path: A file, or the name of a shipped one: train_dyfn_mini.yaml, with or without config/.

    Returns:
        The file.

    Raises:
        ConfigError: If there is none; names the shipped ones.
    """
    if path.exists():
        return path
    folders = config_folders(Path(__file__))
    if path.parent in (Path(), Path("config")):
        name = FORMER_NAMES.get(path.name, path.name)
        for folder in folders:
            if (folder / name).is_file():
                if name != path.name:
                    logger.warning("%s is now called config/%s", path, name)
                return folder / name
    shipped = sorted({found.name for folder in folders for found in folder.glob("train_*.yaml")})
    raise ConfigError(f"no training config at {path}; shipped are {', '.join(shipped)}")


def config_folders(module: Path) -> list[Path]:
    """Where configs are shipped: config/ of a checkout, share/dyfn_ros/config of an installation.

    Args:
        module: A module of this package, whose place tells either.

    Returns:
        The folders that exist, the nearest first.
    """
    places = (p / name for p in module.parents for name in ("config", "share/dyfn_ros/config"))
    return [place for place in places if (place / "train_base_mini.yaml").is_file()]


def override(values: dict[str, Any], setting: str) -> None:
    """Put `key=value` or `key.sub=value` on top of settings. Raises ConfigError."""
    key, found, text = setting.partition("=")
    if not found or not key:
        raise ConfigError(f"--set {setting!r}: expected key=value")
    *parents, last = key.split(".")
    for parent in parents:
        values = values.setdefault(parent, {})
        if not isinstance(values, dict):
            raise ConfigError(f"--set {setting!r}: {parent} holds no settings of its own")
    try:
        values[last] = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {setting!r}: the value is no YAML: {error}") from error
