"""ROS messages to arrays and back; imports no other room."""
