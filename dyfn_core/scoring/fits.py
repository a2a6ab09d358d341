"""The alignments of a prediction with truth, by name."""

L1, LEAST_SQUARES = FITS = ("l1", "lstsq")
