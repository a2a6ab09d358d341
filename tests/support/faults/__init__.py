"""The fault suite: what goes wrong on a robot, done to the real node, and what came of it."""
