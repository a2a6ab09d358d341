"""The one reader of RGB-D folders: training, evaluation, dyfn-replay and dyfn-record use it."""
