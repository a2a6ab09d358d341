"""Metrics and protocols (image, video, metric): used by training and evaluation alike."""
