"""One stream: frames in one at a time, geometry that keeps one scale out."""
