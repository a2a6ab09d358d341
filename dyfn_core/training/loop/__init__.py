"""What every training shares: the loop, checkpoints, processes, the run folder."""
