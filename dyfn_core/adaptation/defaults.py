"""Settings of `dyfn-train adapt` that its command line shows, apart from what imports torch."""

DECODER = ("none", "last", "all")
RATE = 10.0
HOLD_BACK = 0.25
TEST = 0.0
STEPS = 600
SEED = 0
