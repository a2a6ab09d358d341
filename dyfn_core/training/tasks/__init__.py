"""What is trained: the base, and DyFN (unrolled or linearized)."""
