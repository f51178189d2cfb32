"""Touched cells as an OctoMap binary tree, `.bt` (Hornung et al. 2013, Autonomous Robots 34; OcTree::writeBinary).

A tree of 16 levels around the origin. Every inner node is two bytes, written before its children's: two bits for each
child, 00 unknown, 10 occupied leaf, 11 a node with children (the lower bit first in the file's own notation). Whiskers
tell what they touch, not what they pass through: cells are occupied or unknown, none is free.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LEVELS = 16
#: Key of the cell at the origin.
CENTRE = 1 << (LEVELS - 1)
_OCCUPIED, _INNER = 0b10, 0b11


class OctomapSizeError(ValueError):
    """Points beyond what a tree of 16 levels reaches at this resolution."""


def binary_tree(points: FloatArray, resolution: float) -> bytes:
    """An OctoMap file with the cells that hold points.

    Args:
        points: shape (m, 3), m.
        resolution: edge of a cell, m.

    Raises:
        OctomapSizeError: a point farther from the origin than 32768 cells.
    """
    keys = np.floor(np.asarray(points) / resolution).astype(np.int64) + CENTRE
    if len(keys) and (keys.min() < 0 or keys.max() >= 1 << LEVELS):
        reach = CENTRE * resolution
        raise OctomapSizeError(f"points farther than {reach:g} m from the origin; take cells of over {resolution:g} m")
    leaves = np.unique(_codes(keys))
    nodes = [np.unique(leaves >> 3 * (LEVELS - level)) for level in range(LEVELS + 1)]
    size = sum(len(level) for level in nodes) if len(leaves) else 0
    head = f"# Octomap OcTree binary file\nid OcTree\nsize {size}\nres {resolution:.9g}\ndata\n"
    return head.encode() + (_inner_nodes(nodes) if size else b"")


def _codes(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Path of each cell from the root, three bits a level: x lowest, then y, then z."""
    codes = np.zeros(len(keys), dtype=np.int64)
    for level in range(LEVELS):
        for axis in range(3):
            codes |= ((keys[:, axis] >> level) & 1) << (3 * level + axis)
    return codes


def _inner_nodes(nodes: list[NDArray[np.int64]]) -> bytes:
    """All inner nodes, each before its children, two bytes each."""
    paths, depths, values = [], [], []
    for level in range(LEVELS):
        children = nodes[level + 1]
        kind = _OCCUPIED if level == LEVELS - 1 else _INNER
        place = np.searchsorted(nodes[level], children >> 3)
        value = np.zeros(len(nodes[level]), dtype=np.int64)
        np.bitwise_or.at(value, place, kind << 2 * (children & 7))
        paths.append(nodes[level] << 3 * (LEVELS - level))
        depths.append(np.full(len(nodes[level]), level))
        values.append(value)
    order = np.lexsort((np.concatenate(depths), np.concatenate(paths)))
    return np.concatenate(values)[order].astype("<u2").tobytes()
