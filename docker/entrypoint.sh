#!/bin/bash
# ROS's environment, then the command.
set -e
# shellcheck source=/dev/null
source "/opt/ros/${ROS_DISTRO:-jazzy}/setup.bash"
exec "$@"
