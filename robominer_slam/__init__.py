"""Blind SLAM from whisker touches: estimation, SLAM, map, publishing, command line, daemon."""

import os

# Matrices here are small: a BLAS of several threads makes them slower, by ten times where another process keeps a
# core busy, and takes memory for each thread. Read once, when numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__version__ = "0.1.0"
