"""The simulated robot: same serial protocols as the hardware. Only its commands and the tests use it."""

import os

# Two BLAS threads that wait for each other on a core that something else needs made the calibration's fit take 8 to
# 80 s instead of 0.7 s; the matrices here are small. It must be set before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
