"""What a process of this package finds in its environment, so that nothing must be exported."""

from __future__ import annotations

import os
import sys
from pathlib import Path

FASTDDS_PROFILE = Path(__file__).parent / "fastdds_images.xml"
_PREFIXES = "AMENT_PREFIX_PATH"
_PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
_PROFILE_HERE = "DEFAULT_FASTRTPS_PROFILES.xml"  # Fast DDS reads it from the working directory


def _holds_ros(prefix: str) -> bool:
    return (Path(prefix) / "share/ament_index/resource_index/packages/rclpy").is_file()


def prepare_environment() -> None:
    """Call before rclpy.init and before torch is imported. Nothing that is set is changed.

    This environment's prefix goes last on AMENT_PREFIX_PATH, only when it holds a ROS of its own
    (rclpy from wheels) and no listed prefix does: a sourced ROS installation is left alone.
    Fast DDS gets a profile for large messages unless there is one. OpenMP threads sleep while they
    wait: spinning ones take the cores from everything else that a robot runs.
    """
    listed = [prefix for prefix in os.environ.get(_PREFIXES, "").split(os.pathsep) if prefix]
    if _holds_ros(sys.prefix) and not any(_holds_ros(prefix) for prefix in listed):
        os.environ[_PREFIXES] = os.pathsep.join([*listed, sys.prefix])
    if not any(name in os.environ for name in _PROFILES) and not Path(_PROFILE_HERE).exists():
        os.environ[_PROFILES[0]] = str(FASTDDS_PROFILE)
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
