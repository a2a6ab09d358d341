"""Writes docs/cli.md, one table per command, from the commands' own parsers.

python docs/write_cli.py
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from textwrap import fill

from dyfn_core.cli import eval as dyfn_eval
from dyfn_core.cli import export as dyfn_export
from dyfn_core.cli import train as dyfn_train
from dyfn_ros.app import options as dyfn_app
from dyfn_ros.demo import options as dyfn_demo
from dyfn_ros.depth import options as dyfn_depth
from dyfn_ros.record import options as dyfn_record
from dyfn_ros.replay import options as dyfn_replay
from dyfn_worlds import cli as dyfn_worlds

COLUMNS = 110
PAGE = Path(__file__).with_name("cli.md")
HEAD = """# Commands

`python docs/write_cli.py` writes this page from the parsers. `COMMAND --help` prints the same,
`--version` the version. An option means the same in every command. An option's old name still
works, prints the new one on stderr, and is listed in the [changelog](../CHANGELOG.md).

A wrong value ends a command with exit code 2 and one line on stderr. The node's command
`stream_depth` takes ROS arguments; its parameters are in [node.md](node.md).
"""


def parsers() -> list[argparse.ArgumentParser]:
    """The parsers of all commands but the node's, which takes ROS arguments."""
    return [
        dyfn_depth.parser(),
        dyfn_app.parser(),
        dyfn_replay.parser(),
        dyfn_record.parser(),
        dyfn_demo.parser(),
        dyfn_eval.parser(),
        dyfn_export.parser(),
        dyfn_train.parser(),
        dyfn_worlds.parser(),
    ]


def sub_commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Name -> parser of the sub-commands."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def page() -> str:
    """The whole page."""
    parts = [HEAD]
    for parser in parsers():
        parts += section(parser, "##")
        for sub in sub_commands(parser).values():
            parts += section(sub, "###")
    return "\n".join(parts)


def section(parser: argparse.ArgumentParser, heading: str) -> Iterator[str]:
    """Heading, description, table and epilog of one command."""
    yield f"{heading} {parser.prog}\n"
    yield f"{fill(str(parser.description), COLUMNS)}\n"
    rows = list(table(parser))
    if rows:
        yield "\n".join(["| argument | meaning |", "| --- | --- |", *rows]) + "\n"
    if parser.epilog:
        yield f"{fill(parser.epilog, COLUMNS)}\n"


def table(parser: argparse.ArgumentParser) -> Iterator[str]:
    """A row for each group and each of its arguments."""
    for group in parser._action_groups:
        shown = [action for action in group._group_actions if documented(action)]
        if shown and group.title not in ("positional arguments", "options", "optional arguments"):
            yield f"| **{group.title}** | |"
        for action in shown:
            needed = " (required)" if action.required and action.option_strings else ""
            yield f"| `{invocation(action)}` | {text(action, parser)}{needed} |"


def documented(action: argparse.Action) -> bool:
    """Not --help, --version, sub-commands and old names."""
    hidden = (argparse._HelpAction, argparse._VersionAction, argparse._SubParsersAction)
    return not isinstance(action, hidden) and action.help != argparse.SUPPRESS


def invocation(action: argparse.Action) -> str:
    """The argument as one types it."""
    plain = argparse.HelpFormatter(prog="")
    if not action.option_strings:
        return plain._format_args(action, action.dest)
    values = plain._format_args(action, action.dest.upper()) if action.nargs != 0 else ""
    return f"{', '.join(action.option_strings)} {values}".strip().replace("|", "\\|")


def text(action: argparse.Action, parser: argparse.ArgumentParser) -> str:
    """The help text with its default filled in."""
    assert action.help is not None, f"{parser.prog} {action.option_strings} has no help"
    return (action.help % {**vars(action), "prog": parser.prog}).replace("|", "\\|")


def main() -> int:
    """Write the page. -> exit code."""
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
