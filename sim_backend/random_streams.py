"""Independent random streams from one seed, so that one sensor's draws never shift another's."""

from __future__ import annotations

from zlib import crc32

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """The random stream of that name: the same for the same seed and name, unrelated to any other."""
    return np.random.default_rng([seed, crc32(name.encode())])
