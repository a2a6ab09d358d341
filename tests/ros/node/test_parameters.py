"""The parameter table: documented values, and a parameter file that matches it."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import yaml

from dyfn_core.stream.options import StreamOptions, options_of
from dyfn_ros.messages.reference_options import ReferenceOptions
from dyfn_ros.node.parameters import docs as parameter_docs
from dyfn_ros.node.parameters.declare import check, check_cameras
from dyfn_ros.node.parameters.table import CONFIGURE, RUN, SPECS, START, NodeSettings
from dyfn_ros.node.parameters.usage import usage

ROOT = Path(__file__).parents[3]


def test_the_parameter_file_holds_every_parameter_with_its_default() -> None:
    content = yaml.safe_load((ROOT / "config/stream_depth.yaml").read_text())
    assert content == {
        "/**/stream_depth": {
            "ros__parameters": {name: spec.default for name, spec in SPECS.items()}
        }
    }


NODE_FILES = [
    *sorted((ROOT / "config/cameras").glob("*")),
    *sorted((ROOT / "config/recipes").glob("stream_depth*.yaml")),
]


@pytest.mark.parametrize("path", NODE_FILES, ids=lambda p: p.stem)
def test_a_file_of_the_node_sets_parameters_that_are_allowed(path: Path) -> None:
    ((nodes, content),) = yaml.safe_load(path.read_text()).items()
    assert nodes == "/**/stream_depth"
    values = {"use_sim_time": False, **content["ros__parameters"]}
    del values["use_sim_time"]
    own = {name: values.pop(name) for name in values.get("cameras", ()) if name in values}
    assert check_cameras(values.get("cameras", [""])) == ""
    for camera in (values, *own.values()):
        assert set(camera) <= set(SPECS)
        assert check(camera, vars(NodeSettings())) == ""
        for name, value in camera.items():
            assert type(value) is type(SPECS[name].default), name
    assert all(SPECS[name].per_camera for camera in own.values() for name in camera)


def test_manual_and_parameter_file_are_written_from_the_table() -> None:
    """Run `python -m dyfn_ros.node.parameters.docs` after a change of the table."""
    manual = (ROOT / "docs/node.md").read_text()
    assert parameter_docs.updated_manual(manual) == manual
    assert all(f"| `{name}`" in manual for name in SPECS)
    file = (ROOT / "config/stream_depth.yaml").read_text()
    assert parameter_docs.parameter_file() == file


def test_a_manual_without_a_place_for_the_table_is_refused() -> None:
    with pytest.raises(ValueError, match="lacks"):
        parameter_docs.updated_manual("# no place")


def test_every_default_has_the_type_of_its_field_and_lies_in_its_range() -> None:
    defaults = NodeSettings()
    for field in fields(NodeSettings):
        spec = SPECS[field.name]
        assert getattr(defaults, field.name) == spec.default
        kind = "list[str]" if isinstance(spec.default, list) else type(spec.default).__name__
        assert field.type == kind
        assert spec.changes in (START, CONFIGURE, RUN)
        assert not spec.choices or spec.default in spec.choices
        if spec.range:
            assert isinstance(spec.default, (int, float))
            assert spec.range[0] <= spec.default <= spec.range[1]


def test_stream_parameters_are_the_stream_s_options_with_the_same_defaults() -> None:
    described = {**options_of(StreamOptions), **options_of(ReferenceOptions)}
    for name, option in described.items():
        spec = SPECS[name]
        assert (spec.description, spec.range, spec.choices, spec.group) == (
            *(option.description, option.range, option.choices, option.group),
        )
        assert spec.per_camera
        assert spec.changes == (RUN if option.live else CONFIGURE)
    node, stream = NodeSettings(), StreamOptions()
    assert all(getattr(node, name) == getattr(stream, name) for name in options_of(StreamOptions))


@pytest.mark.parametrize(
    ("changes", "in_force", "reason"),
    [
        ({"min_depth": 1.0}, (0.0, 0.0), ""),
        ({"min_depth": 1.0}, (0.0, 2.0), ""),
        ({"min_depth": 2.0}, (0.0, 2.0), "must be below max_depth"),
        ({"max_depth": 1.0}, (1.5, 0.0), "must be below max_depth"),
        ({"max_depth": 0.0}, (1.5, 2.0), ""),
        ({"min_depth": 3.0, "max_depth": 4.0}, (0.0, 2.0), ""),
        ({"points_min_depth": 3.0, "points_max_depth": 3.0}, (0.0, 0.0), "points_max_depth"),
        ({"image_transport": "raw"}, (0.0, 0.0), ""),
        ({"image_transport": "RAW"}, (0.0, 0.0), "expected one of"),
        ({"reliability": "sometimes"}, (0.0, 0.0), "expected one of"),
        ({"use_sim_time": True}, (0.0, 0.0), ""),
    ],
)
def test_changes_are_allowed_together_or_refused(
    changes: dict[str, Any], in_force: tuple[float, float], reason: str
) -> None:
    found = check(changes, dict(zip(("min_depth", "max_depth"), in_force, strict=True)))
    assert reason in found
    assert bool(reason) is bool(found)


@pytest.mark.parametrize(("configured", "allowed"), [(False, True), (True, False)])
def test_what_the_model_is_changes_only_while_unconfigured(configured: bool, allowed: bool) -> None:
    assert (check({"model": "other"}, {}, configured) == "") is allowed
    assert check({"stabilize": False}, {}, configured) == ""


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        ([""], ""),
        (["front", "left_2"], ""),
        ([], "at least one"),
        (["front", ""], "has ''"),
        (["front/left"], "letters, digits"),
        (["2nd"], "letters, digits"),
        (["model"], "something else"),
        (["depth"], "something else"),
        (["a", "b", "a"], "twice"),
    ],
)
def test_names_of_cameras_make_topics_or_are_refused(names: list[str], reason: str) -> None:
    found = check_cameras(names)
    assert reason in found
    assert bool(reason) is bool(found)


def test_help_shows_parameters_and_strange_arguments_are_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    usage(["stream_depth", "--ros-args", "-p", "model:=x"])
    with pytest.raises(SystemExit) as asked:
        usage(["stream_depth", "--help"])
    assert asked.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert all(name in shown and spec.description in shown for name, spec in SPECS.items())
    with pytest.raises(SystemExit) as refused:
        usage(["stream_depth", "--model", "x"])
    assert refused.value.code == 2
