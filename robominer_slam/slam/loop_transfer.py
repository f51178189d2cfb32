"""Moves the loop edges of a keyframe to the one before it, so that merging the two does not let the map go slack.

With the odometry edge (Z_o, Sigma_o, B_o) from the keyframe a to its successor b, at the present biases, an edge that
ends at b becomes one that ends at a, and one that starts at b one that starts at a:

    Z = Z_l Z_o^-1,   Sigma = Ad(Z_o) (Sigma_l + n Sigma_o) Ad(Z_o)',      B = -Ad(Z_o) B_o,
    Z = Z_o Z_l,      Sigma = Sigma_l + n Ad(Z_l^-1) Sigma_o Ad(Z_l^-1)',   B = Ad(Z_l^-1) B_o.

The moved edges and the odometry share the error of the odometry edge. Taken as independent it would be counted more
than once; counting its variance n times in each of the n that share it is safe whatever their correlation:
(s_1; ...; s_n)(s_1; ...; s_n)' <= n diag(s_1 s_1', ..., s_n s_n').

Source: Uhlmann, "Covariance consistency methods for fault-tolerant distributed data fusion" (Information Fusion 2003).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.slam.keyframe_graph import KeyframeGraph

FloatArray = NDArray[np.float64]


def move_loops(graph: KeyframeGraph, key: int, into: int) -> None:
    """Move the loop edges of `key` to `into`, which one odometry edge joins to it; that edge says less thereafter."""
    edges = graph.edges
    loops = edges.loop & edges.enabled & ((edges.i == key) | (edges.j == key))
    chain = np.flatnonzero(~edges.loop & (edges.i == into) & (edges.j == key))
    rows = np.flatnonzero(loops & (edges.i != into) & (edges.j != into))
    if len(chain) != 1 or not len(rows):
        return
    o, bias, shared = int(chain[0]), graph.bias, len(rows) + 1
    Z_o = geometry.se2_compose(edges.Z[o], geometry.se2_exp(edges.jacobian[o] @ (bias - edges.reference[o])))
    Sigma_o, B_o, dz_o = edges.covariance[o].copy(), edges.jacobian[o].copy(), float(edges.dz[o])
    dz_variance = shared / float(edges.dz_information[o])
    for row in rows:
        ends = bool(edges.j[row] == key)
        correction = geometry.se2_exp(edges.jacobian[row] @ (bias - edges.reference[row]))
        Z_l = geometry.se2_compose(edges.Z[row], correction)
        covariance = edges.covariance[row]
        if ends:
            Ad = geometry.se2_adjoint(Z_o)
            Z = geometry.se2_compose(Z_l, geometry.se2_inverse(Z_o))
            covariance = Ad @ (covariance + shared * Sigma_o) @ Ad.T
            edges.jacobian[row] = Ad @ (edges.jacobian[row] - B_o)
            edges.j[row], edges.dz[row] = into, edges.dz[row] - dz_o
        else:
            Ad = geometry.se2_adjoint(geometry.se2_inverse(Z_l))
            Z = geometry.se2_compose(Z_o, Z_l)
            covariance = covariance + shared * Ad @ Sigma_o @ Ad.T
            edges.jacobian[row] = edges.jacobian[row] + Ad @ B_o
            edges.i[row], edges.dz[row] = into, edges.dz[row] + dz_o
        edges.reference[row] = bias
        edges.Z[row] = Z
        edges.dz_information[row] = 1.0 / (1.0 / edges.dz_information[row] + dz_variance)
        edges.set_covariance(int(row), covariance)
    edges.set_covariance(o, shared * Sigma_o)
    edges.dz_information[o] = 1.0 / dz_variance
    edges.renew(rows)
