"""Quake 3 maps and models as scenes."""
