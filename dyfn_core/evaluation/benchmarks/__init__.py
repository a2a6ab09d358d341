"""The public benchmarks of video depth: data sets, runs, tables."""
