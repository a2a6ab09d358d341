"""The options of a stream: one table for the library, the node's parameters and command lines."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

from dyfn_core.stream.picture_check import CONTRAST, FROZEN_AFTER
from dyfn_core.stream.resets import TimeRules
from dyfn_core.stream.scene_cut import THRESHOLD

STREAM, SCALE = "Stream", "Metric scale"
SOURCES = ("none", "fixed", "reference", "camera_height", "odometry", "model")
UNTIL_METRIC = ("withhold", "relative")
AFTER_RESET = ("keep", "withhold")

T = TypeVar("T")


@dataclass(frozen=True)
class Option:
    """What is known of an option besides its default.

    Attributes:
        group: Heading in manuals and help texts.
        description: One or more sentences.
        range: Smallest and largest value, both allowed; for numbers.
        choices: The values allowed; for strings. Empty: any.
        live: Whether it may change between two frames of a stream.
    """

    group: str
    description: str
    range: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    live: bool = False

    def problem(self, name: str, value: Any) -> str:
        """Why a value is not allowed, naming the option; "" when it is."""
        if self.choices and value not in self.choices:
            return f"{name} is {value!r}, expected one of {self.choices}"
        if self.range is not None:
            low, high = self.range
            if not low <= value <= high:
                return f"{name} is {value}, expected {low:.10g} to {high:.10g}"
        return ""


def option(group: str, default: Any, description: str, **details: Any) -> Any:
    """A dataclass field with an Option."""
    return field(default=default, metadata={"option": Option(group, description, **details)})


def options_of(kind: type) -> dict[str, Option]:
    """The options among the fields of a dataclass, by name, in their order."""
    return {f.name: f.metadata["option"] for f in fields(kind) if "option" in f.metadata}


@dataclass(frozen=True)
class StreamOptions:
    """How one camera's stream runs; the same names and defaults everywhere.

    The node's parameters, dyfn-replay's options and StreamSession all come from these fields; see
    docs/node.md for the table. Raises ValueError, naming option, value and what was expected, for
    a value that is not allowed.

    Example:
        >>> StreamOptions(metric_source="fixed", metric_scale=2.0).max_gap
        5.0
        >>> StreamOptions(max_gap=-1.0)
        Traceback (most recent call last):
        ValueError: max_gap is -1.0, expected 0 to 1000000
    """

    stabilize: bool = option(STREAM, True, "Use DyFN. A change resets the stream.", live=True)
    num_tokens: int = option(
        STREAM,
        0,
        "Resolution inside the model; 0 is the model's own. A change resets the stream.",
        range=(0, 4096),
        live=True,
    )
    stamp_tolerance: float = option(
        STREAM,
        TimeRules.tolerance,
        "Seconds that a stamp (or ROS time) may go back before the stream resets.",
        range=(0.0, 1e6),
        live=True,
    )
    max_gap: float = option(
        STREAM,
        TimeRules.max_gap,
        "Seconds from one frame's stamp to the next (or a jump of ROS time) beyond which the "
        "stream resets; 0 is no limit.",
        range=(0.0, 1e6),
        live=True,
    )
    scene_cut_threshold: float = option(
        STREAM,
        THRESHOLD,
        "Difference between consecutive images beyond which the camera is somewhere else and the "
        "stream resets; 0 switches it off. See docs/metric_scale.md.",
        range=(0.0, 2.0),
        live=True,
    )
    blank_contrast: float = option(
        STREAM,
        CONTRAST,
        "Grey levels of structure below which a picture shows nothing (covered lens, flash, "
        "darkness): no pixel of its depth is valid; 0 switches it off.",
        range=(0.0, 128.0),
        live=True,
    )
    frozen_after: float = option(
        STREAM,
        FROZEN_AFTER,
        "Seconds of pictures with the same bytes, at least 10 of them, after which the camera is "
        "frozen and no depth valid; 0 switches it off (a simulator without noise, standing still).",
        range=(0.0, 3600.0),
        live=True,
    )
    scale_memory: bool = option(
        STREAM,
        False,
        "Steady the scale of the depth by key points that the pictures show again; not with "
        "metric_source odometry or model, which have their own. See docs/metric_scale.md.",
    )
    state_file: str = option(
        STREAM,
        "",
        "File that the stream's state is saved to and loaded from (the node: by ~/save_state and "
        "~/load_state; several cameras that share it put their name before the suffix).",
        live=True,
    )
    metric_source: str = option(
        SCALE,
        "none",
        "Source of metres. none: depth is relative. fixed: metric_scale. reference: measurements "
        "on `reference`. camera_height: height over the ground. odometry: poses of the moving "
        "camera, which also steady the depth. model: what a metric model says, filtered.",
        choices=SOURCES,
    )
    metric_scale: float = option(
        SCALE,
        1.0,
        "fixed: metres in one unit of the model's depth.",
        range=(1e-6, 1e6),
        live=True,
    )
    until_metric: str = option(
        SCALE,
        "withhold",
        "Output before a configured source has given a scale. withhold: NaN. relative: depth up "
        "to scale; the topic's unit changes later.",
        choices=UNTIL_METRIC,
        live=True,
    )
    after_reset: str = option(
        SCALE,
        "keep",
        "A measured scale after a reset of the stream. keep: in force, 20% less certain and with a "
        "warning, until the next measurement. withhold: as before the first measurement.",
        choices=AFTER_RESET,
        live=True,
    )
    scale_field: bool = option(
        SCALE,
        True,
        "odometry: also mend the shape of the depth by a smooth field of scale.",
    )
    reference_tolerance: float = option(
        SCALE,
        0.1,
        "Seconds between the stamps of a measurement and of the image it is compared with.",
        range=(1e-3, 10.0),
    )
    reference_history: float = option(
        SCALE,
        1.0,
        "Seconds for which predictions are kept for measurements that come after their image. 0: "
        "such measurements are not used.",
        range=(0.0, 60.0),
    )
    reference_min_depth: float = option(
        SCALE,
        0.01,
        "Metres; nearer measurements are not used.",
        range=(0.0, 1e6),
        live=True,
    )
    reference_max_depth: float = option(
        SCALE,
        200.0,
        "Metres; farther measurements are not used (drivers give large numbers for no return).",
        range=(0.001, 1e6),
        live=True,
    )
    camera_height: float = option(
        SCALE,
        0.0,
        "camera_height: metres from the ground to the camera's centre.",
        range=(0.0, 1000.0),
    )
    camera_pitch: float = option(
        SCALE,
        0.0,
        "camera_height: degrees that the camera looks down.",
        range=(-90.0, 90.0),
    )
    calibration: str = option(
        SCALE,
        "hold",
        "hold: keep the first calibration until the stream resets. track: follow slowly.",
        choices=("hold", "track"),
    )
    calibration_fit: str = option(
        SCALE,
        "scale",
        "Fitted quantity: scale, or scale and shift (for models whose shift is unknown).",
        choices=("scale", "scale_shift"),
    )
    calibration_seconds: float = option(
        SCALE, 1.0, "Seconds of measurements that a fit is made on.", range=(0.01, 600.0)
    )
    calibration_points: int = option(
        SCALE,
        10,
        "Fewest points of a fit; a Range message or a frame's ground plane is one point.",
        range=(2, 100_000),
    )
    tracking_rate: float = option(
        SCALE,
        0.05,
        "track: fastest change of the scale, as a share per second.",
        range=(1e-4, 10.0),
    )
    reference_disagreement: float = option(
        SCALE,
        0.25,
        "Measurements that differ by more from the scale in force (natural logarithm) for 3 s "
        "contradict it: a warning, and with track a new calibration.",
        range=(0.01, 10.0),
    )

    def __post_init__(self) -> None:
        for name, described in options_of(StreamOptions).items():
            if problem := described.problem(name, getattr(self, name)):
                raise ValueError(problem)
        if self.scale_memory and self.metric_source in ("odometry", "model"):
            raise ValueError(
                f"scale_memory is True, expected False with metric_source {self.metric_source!r}, "
                "which finds the scale of every frame itself"
            )
        near, far = self.reference_depths
        if near >= far:
            raise ValueError(
                f"reference_min_depth is {near}, expected less than reference_max_depth {far}"
            )

    @property
    def reference_depths(self) -> tuple[float, float]:
        """Metres between which a measured depth is used."""
        return self.reference_min_depth, self.reference_max_depth

    @property
    def time_rules(self) -> TimeRules:
        """When the stamps of two frames say that the stream must be reset."""
        return TimeRules(self.stamp_tolerance, self.max_gap)


def add_options(
    parser: argparse.ArgumentParser, kind: type = StreamOptions, without: Collection[str] = ()
) -> dict[str, argparse._ArgumentGroup]:
    """Give a parser the options of a dataclass: `--max-gap` for max_gap, one group a heading.

    Args:
        parser: Gets one argument group for each heading.
        kind: A dataclass whose fields were made by `option`, with a default each.
        without: Fields that the caller adds in its own way.

    Returns:
        The groups by heading.

    Example:
        >>> parser = argparse.ArgumentParser()
        >>> groups = add_options(parser)
        >>> options_from(parser.parse_args(["--max-gap", "3"])).max_gap
        3.0
    """
    groups: dict[str, argparse._ArgumentGroup] = {}
    defaults = kind()
    for name, described in options_of(kind).items():
        group = groups.get(described.group)
        if group is None:
            group = parser.add_argument_group(described.group.lower())
            groups[described.group] = group
        if name in without:
            continue
        default = getattr(defaults, name)
        flag = f"--{name.replace('_', '-')}"
        text = described.description.replace("%", "%%")
        if isinstance(default, bool):
            group.add_argument(
                flag,
                action=argparse.BooleanOptionalAction,
                default=default,
                help=f"{text} (default: %(default)s)",
            )
            continue
        shown = default if default != "" else "none"
        group.add_argument(
            flag,
            type=_parsed(described, type(default)),
            default=default,
            choices=described.choices or None,
            metavar=None if described.choices else type(default).__name__.upper(),
            help=f"{text} (default: {shown})",
        )
    return groups


def options_from(
    arguments: argparse.Namespace | Mapping[str, Any],
    kind: type[T] = StreamOptions,  # type: ignore[assignment]
) -> T:
    """The dataclass that parsed arguments describe; other arguments are left alone.

    Raises:
        ValueError: A value is not allowed.
    """
    values = arguments if isinstance(arguments, Mapping) else vars(arguments)
    return kind(**{name: values[name] for name in options_of(kind)})


def _parsed(described: Option, kind: type) -> Callable[[str], Any]:
    what = {int: "a whole number", float: "a number"}.get(kind, "a text")
    if described.range is not None:
        low, high = described.range
        what = f"{what} from {low:.10g} to {high:.10g}"

    def parse(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or (described.range and described.problem("", value)):
            raise argparse.ArgumentTypeError(f"expected {what}, got {text!r}")
        return value

    return parse
