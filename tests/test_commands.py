"""All commands alike: version, help for every option, one clear line for every bad value."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

from dyfn_core import __version__
from dyfn_core.cli import eval as dyfn_eval
from dyfn_core.cli import export as dyfn_export
from dyfn_core.cli import train as dyfn_train
from dyfn_core.cli.arguments import command_parser, renamed
from dyfn_ros.app import cli as dyfn_app
from dyfn_ros.app import options as app_options
from dyfn_ros.demo import cli as dyfn_demo
from dyfn_ros.demo import options as demo_options
from dyfn_ros.depth import cli as dyfn_depth
from dyfn_ros.depth import options as depth_options
from dyfn_ros.record import cli as dyfn_record
from dyfn_ros.record import options as record_options
from dyfn_ros.replay import cli as dyfn_replay
from dyfn_ros.replay import options as replay_options
from dyfn_ros.replay.options import parse
from dyfn_ros.replay.settings import Run, SessionOptions
from dyfn_worlds import cli as dyfn_worlds

WRITER = Path(__file__).parents[1] / "docs/write_cli.py"
Main = Callable[[Sequence[str]], int]
MAINS: dict[str, Main] = {
    "dyfn-depth": dyfn_depth.main,
    "dyfn-app": dyfn_app.main,
    "dyfn-replay": dyfn_replay.main,
    "dyfn-record": dyfn_record.main,
    "dyfn-demo": dyfn_demo.main,
    "dyfn-eval": dyfn_eval.main,
    "dyfn-export": dyfn_export.main,
    "dyfn-train": dyfn_train.main,
    "dyfn-worlds": dyfn_worlds.main,
}
PARSERS: dict[str, Callable[[], argparse.ArgumentParser]] = {
    "dyfn-depth": depth_options.parser,
    "dyfn-app": app_options.parser,
    "dyfn-replay": replay_options.parser,
    "dyfn-record": record_options.parser,
    "dyfn-demo": demo_options.parser,
    "dyfn-eval": dyfn_eval.parser,
    "dyfn-export": dyfn_export.parser,
    "dyfn-train": dyfn_train.parser,
    "dyfn-worlds": dyfn_worlds.parser,
}
EVAL = ["run", "--benchmark", "sintel", "--model", "dyfn-mini", "--data", ".", "--out", "o"]
WORLDS = ["--assets", ".", "--out", "o"]
# A command line, and what its one line on stderr says.
NONSENSE = [
    ("dyfn-depth no_such_file.mp4", "no_such_file.mp4 does not exist; expected a picture"),
    ("dyfn-depth 0 --fov 180", "--fov: expected degrees between 0 and 180, got '180'"),
    ("dyfn-depth 0 --fov 60 --camera-matrix 1 1 1 1", "both give the focal length"),
    ("dyfn-depth 0 --near 3 --far 2", "--near 3 --far 2: expected near below far"),
    ("dyfn-depth 0 --capture-size 640", "--capture-size: expected WIDTHxHEIGHT"),
    ("dyfn-depth 0 --write mp4", "--write: unknown output 'mp4', expected some of video"),
    ("dyfn-depth 0 --metric-source camera_height", "needs --camera-height METRES"),
    ("dyfn-depth 0 --metric-source odometry", "--metric-source"),
    ("dyfn-replay walk --out o --stride 0", "--stride: expected a whole number of 1 or more"),
    ("dyfn-replay walk --out o --max-frames many", "--max-frames"),
    ("dyfn-replay walk --out o --device tpu", "--device: expected auto, cpu, cuda or cuda:N"),
    ("dyfn-replay walk --out o --write everything", "--write"),
    ("dyfn-replay walk --out o --quantity depth", "--prediction-topic, which is not given"),
    ("dyfn-replay no_such_recording --out o", "no_such_recording"),
    ("dyfn-replay walk", "--out"),
    ("dyfn-record no_such_source --out o", "no_such_source does not exist"),
    ("dyfn-record . --out o --rate nan", "--rate: expected a finite number above 0, got 'nan'"),
    ("dyfn-record . --out o --stride -1", "--stride: expected a whole number of 1 or more"),
    ("dyfn-demo no_such_recording", "no_such_recording"),
    ("dyfn-demo --max-frames 0", "--max-frames: expected a whole number of 1 or more"),
    ("dyfn-demo --domain x", "--domain: expected a whole number of 0 or more, got 'x'"),
    (" ".join(["dyfn-eval", *EVAL, "--stride", "0"]), "--stride"),
    (" ".join(["dyfn-eval", *EVAL, "--num-tokens", "few"]), "--num-tokens"),
    (" ".join(["dyfn-eval", *EVAL, "--device", "gpu"]), "--device: expected auto, cpu, cuda"),
    (" ".join(["dyfn-eval", *EVAL, "--depth-max", "0"]), "--depth-max: expected a number above 0"),
    ("dyfn-eval run --benchmark nil --data . --model m --out o", "'nil'"),
    ("dyfn-eval reconstruct . --out o --offsets 0", "--offsets"),
    ("dyfn-eval study . --out o --factors 0", "--factors: expected a finite number above 0"),
    ("dyfn-eval", "COMMAND"),
    ("dyfn-export dyfn-mini --out o --size 640", "--size: expected WIDTHxHEIGHT"),
    ("dyfn-export no_such_model --out o", "no model 'no_such_model'"),
    ("dyfn-export dyfn-mini", "--out"),
    ("dyfn-train base --out o --max-steps 0", "--max-steps"),
    ("dyfn-train evaluate m --stride x", "--stride"),
    ("dyfn-train experiments --seeds 0", "--seeds"),
    ("dyfn-train nonsense", "'nonsense'"),
    ("dyfn-worlds --assets no_such_folder --out o", "--assets no_such_folder: no such folder"),
    (" ".join(["dyfn-worlds", *WORLDS, "--size", "abc"]), "HEIGHTxWIDTH such as 240x320"),
    (" ".join(["dyfn-worlds", *WORLDS, "--size", "0x10"]), "HEIGHTxWIDTH such as 240x320"),
    (" ".join(["dyfn-worlds", *WORLDS, "--shards", "-1"]), "--shards"),
    (" ".join(["dyfn-worlds", *WORLDS, "--clip-fps", "0"]), "--clip-fps"),
    (" ".join(["dyfn-worlds", *WORLDS, "--pace", "static"]), "--pace is that of clips"),
    (
        " ".join(["dyfn-worlds", *WORLDS, "--clip-frames", "8", "--placement", "low"]),
        "--placement is that of views",
    ),
]


def with_sub_commands(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices.values()


def code_of(main: Main, words: Sequence[str]) -> int:
    try:
        return main(words)
    except SystemExit as stop:
        assert isinstance(stop.code, int)
        return stop.code


@pytest.mark.parametrize("command", PARSERS)
def test_version(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(MAINS[command], ["--version"]) == 0
    assert capsys.readouterr().out == f"{command} {__version__}\n"


@pytest.mark.parametrize("command", PARSERS)
def test_every_option_and_command_is_explained(command: str) -> None:
    for parser in with_sub_commands(PARSERS[command]()):
        assert parser.description and parser.description[0].isupper(), parser.prog
        for action in parser._actions:
            if not isinstance(action, argparse._SubParsersAction):
                assert action.help, f"{parser.prog} {action.option_strings or action.dest}"


@pytest.mark.parametrize("command", PARSERS)
def test_help_can_be_printed(command: str) -> None:
    for parser in with_sub_commands(PARSERS[command]()):
        assert parser.prog in parser.format_help()


# Reads a module a line and the words after it; writes what of SLOW its main has imported.
HELP = """
import contextlib, importlib, io, sys
for line in sys.stdin:
    module, *words = line.split()
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):
        importlib.import_module(module).main(words)
    slow = ("torch", "scipy", "matplotlib", "pydantic", "tqdm", "trimesh")
    print(module, *words[:-1], "usage: " in said.getvalue(), *(m for m in slow if m in sys.modules))
"""


def test_help_comes_without_torch() -> None:
    lines = [
        f"{MAINS[parser.prog.split()[0]].__module__} {' '.join(parser.prog.split()[1:])} --help"
        for command in sorted(PARSERS)
        for parser in with_sub_commands(PARSERS[command]())
    ]
    run = subprocess.run(
        [sys.executable, "-c", HELP],
        input="\n".join(lines),
        capture_output=True,
        text=True,
        check=True,
    )
    expected = [f"{' '.join(line.split()[:-1])} True" for line in lines]
    assert run.stdout.splitlines() == expected


def test_one_option_has_one_meaning() -> None:
    """The same words of help wherever an option of these names is, defaults apart."""
    shared = ("--device", "--stride", "--max-frames", "--stabilize", "--controls", "--num-tokens")
    texts: dict[str, set[str]] = {}
    for make in PARSERS.values():
        for parser in with_sub_commands(make()):
            for action in parser._actions:
                for name in set(action.option_strings).intersection(shared):
                    texts.setdefault(name, set()).add(str(action.help).split(" (default")[0])
    assert set(texts) == set(shared)
    assert {name: len(found) for name, found in texts.items()} == dict.fromkeys(shared, 1)


@pytest.mark.parametrize(("line", "told"), NONSENSE)
def test_nonsense_gives_one_line_and_code_2(
    line: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command, *words = line.split(" ")
    assert code_of(MAINS[command], words) == 2
    said = capsys.readouterr().err
    assert told in said
    assert said.startswith(command) and said.count("\n") == 1, said


def parser_with_old_names() -> argparse.ArgumentParser:
    parser = command_parser("made", "A made command.")
    renamed(parser, "--root", parser.add_argument("--data", required=True, help="folder"))
    flag = parser.add_argument("--use", action=argparse.BooleanOptionalAction, default=True)
    renamed(parser, "--no-user", flag, "--no-use")
    renamed(parser, "--many", parser.add_argument("--some", action="append", type=int))
    return parser


def test_old_names_do_what_the_new_ones_do(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--root", "there", "--no-user", "--many", "1", "--some", "2"]
    found = parser_with_old_names().parse_args(words)
    assert (found.data, found.use, found.some) == ("there", False, [1, 2])
    assert capsys.readouterr().err.splitlines() == [
        "made: --root is deprecated, use --data",
        "made: --no-user is deprecated, use --no-use",
        "made: --many is deprecated, use --some",
    ]


def test_new_names_say_nothing_and_help_hides_the_old(capsys: pytest.CaptureFixture[str]) -> None:
    parser = parser_with_old_names()
    assert parser.parse_args(["--data", "x"]).use is True
    assert capsys.readouterr().err == ""
    assert "--root" not in parser.format_help() and "--data" in parser.format_help()


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (["--recording", "walk"], "recording", "walk"),
        (["walk"], "recording", "walk"),
        ([], "recording", "demo"),
    ],
)
def test_the_demo_takes_its_recording_by_the_old_name_too(
    words: list[str], name: str, value: str
) -> None:
    assert getattr(demo_options.parse(words), name).name == value


def test_the_page_of_commands_is_current() -> None:
    spec = spec_from_file_location("write_cli", WRITER)
    assert spec is not None and spec.loader is not None
    writer = module_from_spec(spec)
    spec.loader.exec_module(writer)
    assert writer.PAGE.read_text(encoding="utf-8") == writer.page(), f"run python {WRITER}"


def test_eval_takes_its_old_names(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "--benchmark", "b", "--model", "m", "--out", "o", "--root", "there"]
    words += ["--first", "2", "--frames", "5", "--no-stabilizer"]
    found = dyfn_eval.parser().parse_args(words)
    assert (str(found.data), found.start, found.max_frames) == ("there", 2, 5)
    assert found.stabilize is False and found.controls is True
    assert capsys.readouterr().err.count("is deprecated, use") == 4


def test_train_takes_its_old_names(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["evaluate", "m", "--rendered", "worlds", "--recording", "walk", "--data", "more"]
    assert dyfn_train.parser().parse_args(words).data == ["worlds", "walk", "more"]
    words = ["experiments", "--recording", "walk"]
    assert [path.name for path in dyfn_train.parser().parse_args(words).recording] == ["walk"]
    assert capsys.readouterr().err.count("is deprecated, use --data") == 3


def test_zero_tokens_are_the_models_own_as_in_the_node() -> None:
    command = parse(["walk", "--out", "out", "--num-tokens", "0"])
    assert isinstance(command.job.run, Run)
    assert command.job.run.stream.num_tokens == SessionOptions().num_tokens == 0
