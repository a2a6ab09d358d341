"""What a command line of the evaluation may choose, apart from the modules that import torch."""

AUTO, ORIGINAL, DEPTHCRAFTER = LAYOUTS = ("auto", "original", "depthcrafter")
CHAINED, TRUE = PARTNER_POSES = ("chained", "true")
POINTS, POSES = METRES = ("points", "poses")
# Frames of dyfn-eval long.
LENGTHS = (100, 200, 300, 400, 500)
# The paper's partners of frame j: j-1, j-5, j-21.
OFFSETS = (1, 5, 21)
# Of mean and deviation, in the paper's empirical study.
FACTORS = (0.5, 0.625, 0.8, 1.0, 1.25, 1.6, 2.0)
