"""Models as ONNX files: the pure step (image, state) -> (points, mask, state)."""
