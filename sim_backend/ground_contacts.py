"""Where rods can meet the surface: tangent planes under their ends and a ridge under their shafts, kept in place.

MuJoCo's height field is of no use under a rod (see `whisker_model.build`), and a gallery has no height. So each
whisker has, as mocap bodies,

- one plane for every smooth part of the surface (floor, wall), tangent to it at the projection of the rod's end; in
  a corner it leans on two of them;
- one sphere, the ridge: just below the surface where the shaft comes closest to it. The shaft is held there and not
  at the tangent plane's ends, as a plane parallel to the rod would hold it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backend.touch_surface import Surface

FloatArray = NDArray[np.float64]

#: Radius of a ridge, m. Wide enough that the slope under a rod that slides over it is right until it is laid anew
#: (3 mm: 8 deg), narrow enough to lie below the surface everywhere but at edges sharper than this.
RIDGE_RADIUS = 0.02
#: Places along the rod that are looked at, as shares of the way from joint to end; the last is the end itself. They
#: are 18 mm apart and the closest is refined: ground that curves by its radius of 4 cm rises 1 mm in between.
PLACES = np.array([0.4, 0.52, 0.64, 0.76, 0.88, 1.0])
#: A plane with the joint this close to it, m, or behind it, is no ground that this rod can stand on: it belongs to
#: rock that the joint is inside of, or to the back of an edge.
JOINT_CLEARANCE = 0.01
#: Where planes go that are out of use, m along their normal: into the rock.
AWAY = 1.0


class GroundContacts:
    """Poses of the planes and ridges of n whiskers over a surface of s parts.

    Attributes:
        parts: number of parts of the surface.
        position: of planes part after part, then of the ridges, shape (s + 1, n, 3), m, map frame.
        quaternion: w x y z, not normalised (MuJoCo does), shape (s + 1, n, 4); a plane's z-axis is its normal.
    """

    def __init__(self, surface: Surface, reach: FloatArray, quick: Surface | None = None) -> None:
        """Watch over the rods of an array.

        Args:
            surface: what the rods' ends lie on.
            reach: of the rods from the joint to the centre of the rounded end, shape (n,), m.
            quick: the same surface, less smooth and faster, where the shafts' closest places are looked for.
        """
        n = len(reach)
        self.parts = len(surface.parts(np.zeros((3, 1))))
        self._surface, self._quick, self._reach = surface, quick or surface, reach
        self._along = PLACES[:-1, None] * reach
        self._each = np.arange(n)
        self.position = np.full((self.parts + 1, n, 3), -10.0)
        self.quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (self.parts + 1, n, 1))

    def place(self, joint: FloatArray, direction: FloatArray) -> None:
        """Lay planes and ridges for rods from `joint` in `direction`, both of shape (3, n), map frame, m."""
        rod = self._reach * direction
        end = joint + rod
        nearest = np.full(len(self._reach), np.inf)
        for part, (gap, gradient) in enumerate(self._surface.parts(end)):
            distance, normal = _unit(gap, gradient)
            nearest = np.minimum(nearest, distance)
            behind = distance - np.add.reduce(rod * normal) < JOINT_CLEARANCE
            self.position[part] = (end - (distance + AWAY * behind) * normal).T
            # The shortest turn of the plane's z-axis to the normal, also where that points straight down.
            turn = self.quaternion[part]
            turn[:, 0] = 1.0 + normal[2]
            turn[:, 1] = -normal[1]
            turn[:, 2] = normal[0] + 1e-12
        p = joint[:, None, :] + self._along * direction[:, None, :]
        gap, gradient = self._quick.gap(p.reshape(3, -1))
        clearance = np.empty((len(PLACES), len(nearest)))
        clearance[:-1] = _unit(gap, gradient)[0].reshape(p.shape[1:])
        clearance[-1] = nearest
        self._place_ridges(joint, rod, clearance)

    def _place_ridges(self, joint: FloatArray, rod: FloatArray, clearance: FloatArray) -> None:
        """Lay ridges under the closest places of the shafts; clearances at PLACES, shape (places, n), m."""
        closest = clearance[1:-1].argmin(axis=0) + 1
        before, at, after = (clearance[closest + k, self._each] for k in (-1, 0, 1))
        # The lowest point of the parabola through three places.
        bend = np.maximum(before - 2.0 * at + after, 1e-6)
        shift = np.minimum(np.maximum(0.5 * (before - after) / bend, -1.0), 0.9)
        p = joint + (PLACES[closest] + shift * (PLACES[1] - PLACES[0])) * rod
        distance, normal = _unit(*self._quick.gap(p))
        self.position[-1] = (p - (distance + RIDGE_RADIUS) * normal).T


def _unit(gap: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance and normal from a surface's value and gradient, to the first order."""
    steep = np.sqrt(np.add.reduce(gradient * gradient))
    return gap / steep, gradient / steep
