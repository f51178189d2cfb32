"""Two pose graphs of the same drive, keyframe by keyframe: `same_trajectory.py ONE.json OTHER.json`.

The files are those of `replay --graph`. The same keyframes are expected, each at the same place within 1 mm and
0.1 deg; exits 1 if they are not.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

LARGEST_M = 0.001
LARGEST_DEG = 0.1


def main() -> None:
    """Compare, and print the largest differences."""
    one, other = (json.loads(Path(path).read_text(encoding="utf-8")) for path in sys.argv[1:3])
    stamps = [[keyframe["stamp_ns"] for keyframe in graph["keyframes"]] for graph in (one, other)]
    loops = [sum(edge["kind"] == "loop" for edge in graph["edges"]) for graph in (one, other)]
    if stamps[0] != stamps[1]:
        print(f"FAILED: {len(stamps[0])} keyframes and {len(stamps[1])}, or at other times")
        sys.exit(1)
    a, b = (np.array([keyframe["pose"] for keyframe in graph["keyframes"]]) for graph in (one, other))
    away = float(np.linalg.norm(a[:, :3] - b[:, :3], axis=1).max())
    turned = float(np.rad2deg((Rotation.from_quat(a[:, 3:]).inv() * Rotation.from_quat(b[:, 3:])).magnitude()).max())
    ok = away <= LARGEST_M and turned <= LARGEST_DEG
    print(
        f"{'ok' if ok else 'FAILED'}: {len(a)} keyframes, {loops[0]} and {loops[1]} loop closures; "
        f"at most {1e3 * away:.2g} mm and {turned:.2g} deg apart"
    )
    sys.exit(not ok)


if __name__ == "__main__":
    main()
