"""The files of a recording as a stream of raw messages, one module for each format."""
