"""Cheap relatives of the paper's terms: a few hundred samples, a few random anchors."""
