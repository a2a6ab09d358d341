"""The paper's objective: every pixel, exact alignments, MoGe's averages."""
