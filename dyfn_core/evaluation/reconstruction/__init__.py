"""Reconstruction from predicted depth: matches, registered poses, clouds, their errors."""
