"""What `stream_depth --help` says: the parameters, their descriptions and defaults."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from textwrap import wrap

from rclpy.utilities import remove_ros_args

from dyfn_core.cli.arguments import command_parser
from dyfn_ros.node.parameters.table import groups, show


def usage(arguments: Sequence[str]) -> None:
    """Take what is not for ROS from the command line: --help, or an error that ends the program.

    arguments: with the program's name first.
    """
    lines = []
    for group, specs in groups().items():
        lines.append(f"\n{group}:")
        for name, spec in specs.items():
            lines.append(f"  {name} [{show(spec.default)}]")
            lines += wrap(spec.description, 90, initial_indent=" " * 6, subsequent_indent=" " * 6)
    parser = command_parser(
        "stream_depth",
        "Images in, depth and clouds out. Parameters and [defaults]:",
        "\n".join(lines),
    )
    parser.usage = (
        "stream_depth [--ros-args -r image:=TOPIC -r camera_info:=TOPIC -p NAME:=VALUE ...]"
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.parse_args(remove_ros_args(list(arguments))[1:])
