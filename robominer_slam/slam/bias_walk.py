"""Biases that walk: what the graph learns of a bias now says little of what it was long ago.

The graph solves for the biases b of now. Of an edge made k keyframes ago, the smoothed estimate follows them as

    b_k = ... + C_k C_{k+1} ... C_{n-1} (change of b),      C = P (P + W)^-1,

with P the odometry's covariance of the biases at a keyframe and W what they walk until the next (Rauch, Tung, Striebel,
"Maximum likelihood estimates of linear dynamic systems", AIAA Journal 1965). So each keyframe takes C off the Jacobians
of all edges before it. What they have learned so far stays in their measurements.

The biases of faded edges are then taken as known; their errors, alike in neighbours, come back as noise of each. In the
steady state the smoothed variance is P / (1 + C), neighbours correlate with C, and independent errors of the variance
P / (1 + C) (1 + C) / (1 - C) = P + P W^-1 P have the same sum over many edges.

Biases that do not walk (W = 0) have C = 1: one unknown for the whole drive.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.slam.level_edges import LevelEdges

FloatArray = NDArray[np.float64]

#: Edges are touched when so much has come together: sooner is work for nothing.
LEAST_FADING = 0.01
#: An edge that has faded so far has its biases for known, and their errors for noise.
FADED = 0.7


def smoothing_gain(covariance: FloatArray, walk: FloatArray) -> FloatArray:
    """C of the equations above, shape (nb, nb)."""
    return np.asarray(np.linalg.solve((covariance + walk).T, covariance.T).T, dtype=np.float64)


def faded_noise(jacobian: FloatArray, covariance: FloatArray, walk: FloatArray) -> FloatArray:
    """Covariance that an edge gets when it has faded, shape (3, 3); zero where nothing walks."""
    if not walk.any():
        return np.zeros((3, 3))
    independent = covariance + covariance @ np.linalg.solve(walk, covariance)
    return np.asarray(jacobian @ independent @ jacobian.T, dtype=np.float64)


class BiasWalk:
    """Takes the walk of the biases from the edges of a graph, some keyframes at a time."""

    def __init__(self) -> None:
        self._gain: FloatArray | None = None

    def step(self, edges: LevelEdges, bias: FloatArray, covariance: FloatArray, walk: FloatArray | None) -> None:
        """A keyframe is about to be added.

        Args:
            edges: of the graph so far.
            bias: the graph's estimate before that keyframe, shape (nb,).
            covariance: what the odometry said of it at the last keyframe, shape (nb, nb).
            walk: since the last keyframe, shape (nb, nb).
        """
        if walk is None or not walk.any() or not len(edges) or covariance.shape != walk.shape:
            return
        gain = smoothing_gain(covariance, walk)
        self._gain = gain if self._gain is None or self._gain.shape != gain.shape else gain @ self._gain
        if float(np.abs(np.eye(bias.size) - self._gain).max()) < LEAST_FADING:
            return
        fade(edges, bias, self._gain)
        self._gain = None


def fade(edges: LevelEdges, bias: FloatArray, gain: FloatArray) -> None:
    """Take `gain` (nb, nb) off the Jacobians of all edges; their measurements keep what `bias` makes of them."""
    J = edges.jacobian
    twist = (J @ (bias - edges.reference)[:, :, None])[:, :, 0]
    moved = twist.any(axis=1)
    edges.Z[moved] = geometry.se2_compose(edges.Z[moved], geometry.se2_exp(twist[moved]))
    edges.reference[:] = bias
    edges.jacobian[:] = J @ gain
    edges.fade[:] *= float(np.diag(gain).mean())
    for row in np.flatnonzero((edges.fade < FADED) & edges.slack.any(axis=(1, 2))):
        edges.set_covariance(int(row), edges.covariance[row] + edges.slack[row])
        edges.slack[row] = 0.0
