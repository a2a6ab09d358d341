"""What several test files share: made data, small models, a ROS graph."""
