"""The lifecycle node; the only room, with demo, that knows rclpy."""
