"""Where cameras stand and how they move."""
