"""The terms of the training objectives.

full/ holds the paper's objective over every pixel and all anchors of the alignments, sampled/ its
cheap relatives over a few hundred samples, under the same names. What both use (targets,
resampling, motion, the error of a clip under an alignment) and the terms that are not the paper's
are here.
"""
