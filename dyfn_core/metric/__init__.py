"""A metric scale for depth that is right up to one scale: fits, references, tracking."""
