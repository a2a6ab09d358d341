"""A virtual environment as a ROS prefix, so that nothing must be exported by hand."""

from __future__ import annotations

import os
import sys
from pathlib import Path

_VARIABLE = "AMENT_PREFIX_PATH"


def _holds_ros(prefix: str) -> bool:
    return (Path(prefix) / "share/ament_index/resource_index/packages/rclpy").is_file()


def prepare_environment() -> None:
    """Call before rclpy.init. Puts this environment's prefix last on AMENT_PREFIX_PATH.

    Only when it holds a ROS of its own (rclpy from wheels) and no listed prefix does: a sourced
    ROS installation is left alone.
    """
    listed = [prefix for prefix in os.environ.get(_VARIABLE, "").split(os.pathsep) if prefix]
    if _holds_ros(sys.prefix) and not any(_holds_ros(prefix) for prefix in listed):
        os.environ[_VARIABLE] = os.pathsep.join([*listed, sys.prefix])
