"""The trainer of the base model and of the stabilizer."""
