"""Streaming monocular geometry that keeps its scale (no ROS in here)."""
