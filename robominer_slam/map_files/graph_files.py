"""Keyframes and edges of a saved map as a TUM trajectory and as a g2o graph."""

from __future__ import annotations

import numpy as np

from robominer_slam.evaluation.trajectory import tum_line
from robominer_slam.slam.g2o_format import G2oGraph, format_g2o
from robominer_slam.slam.saved_map import SavedMap


def tum(saved: SavedMap) -> str:
    """The keyframes' poses in map by time, stamped with UNIX time."""
    return "".join(tum_line(k.stamp_ns, T) for k, T in zip(saved.keyframes, saved.poses, strict=True))


def g2o(saved: SavedMap) -> str:
    """The pose graph in three dimensions; edges without weight are left out, the first keyframe is held."""
    place = {key: k for k, key in enumerate(saved.ids)}
    edges = [edge for edge in saved.edges if edge.weight > 0.0]
    count = len(edges)
    return format_g2o(
        G2oGraph(
            dim=3,
            ids=np.array(saved.ids, dtype=np.int64),
            poses=saved.poses,
            i=np.array([place[edge.i] for edge in edges], dtype=np.int64),
            j=np.array([place[edge.j] for edge in edges], dtype=np.int64),
            measurements=np.array([edge.T_i_j for edge in edges]).reshape(count, 4, 4),
            information=np.array([edge.weight * edge.information for edge in edges]).reshape(count, 6, 6),
            fixed=(0,) if saved.ids else (),
        )
    )
