"""Rendered training worlds with exact depth, intrinsics and poses."""
