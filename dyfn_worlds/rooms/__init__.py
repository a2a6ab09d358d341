"""Procedural rooms and their furniture."""
