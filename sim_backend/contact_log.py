"""Which rods were pressed, where and how deep, noted every few steps of the physics."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim_backend.whisker_model import GEOM_PREFIX

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Contacts are looked at every 8 ms: half an interval is a tenth of the frame.
CONTACT_STEPS = 2
#: Normal force above which a contact counts, N: a thousandth of what bends a whisker by one degree.
CONTACT_FORCE = 1e-5


class ContactLog:
    """Contacts of n rods with ground and objects, as copies of MuJoCo's lists that are sorted out once per frame."""

    def __init__(self, model: mujoco.MjModel, count: int) -> None:
        """Rods are the geoms that `whisker_model.build` gave their names to."""
        self._count = count
        self._whisker_of_geom = np.full(model.ngeom, -1)
        for i in range(count):
            self._whisker_of_geom[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, f"{GEOM_PREFIX}{i}")] = i
        self.clear()

    def clear(self) -> None:
        """Begin anew at row 0."""
        self._rows = 0
        self._noted: list[tuple[FloatArray, ...]] = []
        self._row: list[NDArray[np.intp]] = []

    def note(self, data: mujoco.MjData) -> None:
        """Take the contacts of the step that was just done down as the next row."""
        if data.ncon:
            found = data.contact
            address = found.efc_address
            # A contact's first row of the constraints is normal; contacts within the margin alone have none.
            force = np.where(address >= 0, data.efc_force[address], 0.0)
            self._noted.append((found.geom.copy(), found.dist.copy(), found.pos.copy(), force))
            self._row.append(np.full(len(address), self._rows))
        self._rows += 1

    def at(self, row: NDArray[np.intp]) -> tuple[BoolArray, FloatArray, FloatArray]:
        """State of each rod at a row of its own, of shape (n,).

        Returns:
            Whether it is pressed, depth of its deepest contact (m, NaN without), both of shape (n,), and the place
            pressed most, shape (n, 3), m, map frame, NaN where it is not pressed.
        """
        pressed = np.zeros(self._count, dtype=np.bool_)
        depth, point = np.full(self._count, np.nan), np.full((self._count, 3), np.nan)
        if not self._noted:
            return pressed, depth, point
        geom, dist, pos, force = (np.concatenate(part) for part in zip(*self._noted, strict=True))
        who = self._whisker_of_geom[geom]
        # One of the two is a rod, the other none; contacts of a rod with another have no -1.
        chosen = np.flatnonzero((who.min(axis=1) < 0) & (np.concatenate(self._row) == row[who.max(axis=1)]))
        chosen = chosen[np.argsort(force[chosen])]
        who = who.max(axis=1)[chosen]
        near = force[chosen] > 0.0
        np.fmax.at(depth, who[near], -dist[chosen[near]])
        firm = chosen[force[chosen] > CONTACT_FORCE]
        who = who[len(who) - len(firm) :]
        # Of several values for one place the last is kept: that of the largest force.
        pressed[who], point[who] = True, pos[firm]
        return pressed, depth, point
