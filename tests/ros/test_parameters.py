"""The parameter table: documented values, and a parameter file that matches it."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest
import yaml
from rclpy.parameter import Parameter

from dyfn_ros.parameters import SPECS, Settings, check, usage

CONFIG = Path(__file__).parents[2] / "config/stream_depth.yaml"


def test_the_parameter_file_holds_every_parameter_with_its_default() -> None:
    content = yaml.safe_load(CONFIG.read_text())
    assert content == {
        "/**/stream_depth": {
            "ros__parameters": {name: spec.default for name, spec in SPECS.items()}
        }
    }


def test_every_parameter_is_read_into_the_settings_with_its_type() -> None:
    types = {field.name: field.type for field in fields(Settings)}
    assert types == {name: type(spec.default).__name__ for name, spec in SPECS.items()}


@pytest.mark.parametrize(
    ("changes", "in_force", "allowed"),
    [
        ({"min_depth": 1.0}, (0.0, 0.0), True),
        ({"min_depth": 1.0}, (0.0, 2.0), True),
        ({"min_depth": 2.0}, (0.0, 2.0), False),
        ({"max_depth": 1.0}, (1.5, 0.0), False),
        ({"max_depth": 0.0}, (1.5, 2.0), True),
        ({"min_depth": 3.0, "max_depth": 4.0}, (0.0, 2.0), True),
        ({"image_transport": "raw"}, (0.0, 0.0), True),
        ({"image_transport": "RAW"}, (0.0, 0.0), False),
        ({"reliability": "sometimes"}, (0.0, 0.0), False),
        ({"use_sim_time": True}, (0.0, 0.0), True),
    ],
)
def test_changes_are_allowed_together_or_refused(
    changes: dict[str, object], in_force: tuple[float, float], allowed: bool
) -> None:
    parameters = [Parameter(name, value=value) for name, value in changes.items()]
    result = check(parameters, in_force)
    assert result.successful is allowed
    assert bool(result.reason) is not allowed


@pytest.mark.parametrize(
    ("reliability", "drop_frames", "reliable"),
    [
        ("auto", True, False),
        ("auto", False, True),
        ("best_effort", False, False),
        ("reliable", True, True),
    ],
)
def test_auto_reliability_follows_drop_frames(
    reliability: str, drop_frames: bool, reliable: bool
) -> None:
    values = {name: spec.default for name, spec in SPECS.items()}
    values.update(reliability=reliability, drop_frames=drop_frames)
    assert Settings(**values).reliable is reliable  # type: ignore[arg-type]


def test_the_manual_lists_every_parameter_as_it_is() -> None:
    rows = [
        f"| `{name}`{'*' if spec.read_only else ''} | {str(spec.default).lower()} "
        f"| {spec.description} |"
        for name, spec in SPECS.items()
    ]
    manual = (CONFIG.parents[1] / "docs/node.md").read_text()
    assert [line for line in manual.splitlines() if line.startswith("| `")][-len(rows) :] == rows


def test_help_shows_parameters_and_strange_arguments_are_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    usage(["stream_depth", "--ros-args", "-p", "model:=x"])
    with pytest.raises(SystemExit) as asked:
        usage(["stream_depth", "--help"])
    assert asked.value.code == 0
    shown = capsys.readouterr().out
    assert all(name in shown and spec.description in shown for name, spec in SPECS.items())
    with pytest.raises(SystemExit) as refused:
        usage(["stream_depth", "--model", "x"])
    assert refused.value.code == 2
