"""ROS 2 node and recording tools around dyfn_core."""
