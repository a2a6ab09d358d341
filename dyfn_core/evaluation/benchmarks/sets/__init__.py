"""One module for each benchmark: its layout, frames, crops and caps."""
