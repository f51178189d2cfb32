"""The pose graph as the JSON of `map/graph`, and its loop closures alone as that of `map/closures`."""

from __future__ import annotations

import json

import numpy as np

from robominer_slam import geometry
from robominer_slam.mapping.keyframe_map import KeyframeMap

UPPER = np.triu_indices(6)
#: Closures in one answer: below what a slow link carries at once.
MOST_CLOSURES = 500


def closures_json(keyframe_map: KeyframeMap, first: int) -> str:
    """At most 500 pairs of keyframe ids, from a first one on: {"version", "total", "first", "pairs": [[i, j], ...]}."""
    pairs = [[edge.i, edge.j] for edge in keyframe_map.edges if edge.kind == "loop"]
    part = pairs[first : first + MOST_CLOSURES]
    answer = {"version": keyframe_map.version, "total": len(pairs), "first": first, "pairs": part}
    return json.dumps(answer, separators=(",", ":"))


def graph_json(keyframe_map: KeyframeMap, clock_offset_ns: int) -> str:
    """Keyframes and edges: poses as x y z qx qy qz qw, information as its upper triangle, row by row.

    Args:
        keyframe_map: the map.
        clock_offset_ns: added to the keyframes' stamps to make them UNIX time.
    """
    vectors = geometry.to_vector7(keyframe_map.poses)
    return json.dumps(
        {
            "version": keyframe_map.version,
            "keyframes": [
                {"id": k.id, "stamp_ns": k.stamp_ns + clock_offset_ns, "pose": [float(v) for v in vector]}
                for k, vector in zip(keyframe_map.keyframes, vectors, strict=True)
            ],
            "edges": [
                {
                    "kind": edge.kind,
                    "i": edge.i,
                    "j": edge.j,
                    "T_i_j": geometry.to_vector7(edge.T_i_j).tolist(),
                    "information": edge.information[UPPER].tolist(),
                    "weight": edge.weight,
                }
                for edge in keyframe_map.edges
            ],
        }
    )
