"""The home of the demo recording, its daylight, and the robot that drives through it."""
