"""Recordings read and written: ROS 1 bags, sqlite3, MCAP, RGB-D folders."""
