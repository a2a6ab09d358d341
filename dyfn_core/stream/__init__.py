"""What a camera stream needs around DepthStream: scene cuts, and state on disk."""
