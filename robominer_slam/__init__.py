"""Blind SLAM from whisker touches: estimation, SLAM, map, publishing, command line, daemon."""

__version__ = "0.1.0"
