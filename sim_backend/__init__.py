"""The simulated robot: same serial protocols as the hardware. Only its commands and the tests use it."""

import os

# Two BLAS threads that wait for each other on a core that something else needs made the calibration's fit take 8 to
# 80 s instead of 0.7 s; the matrices here are small. It must be set before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# MuJoCo looks for a window system when it is imported, and fails where there is none. Pictures are rendered without
# one (scene_view.py); everything else needs none.
os.environ.setdefault("MUJOCO_GL", "disable")
