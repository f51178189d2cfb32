"""Physics engine: the whisker array in MuJoCo, carried along a motion, read as its sensors are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from robominer_slam.layout import WhiskerLayout
from sim_backend import whisker_model
from sim_backend.base_motion import BaseMotion
from sim_backend.carriers import carrier_states
from sim_backend.whisker_model import CARRIER_MASS, GEOM_PREFIX, ContactModel, WhiskerMechanics
from sim_backend.world import World

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: 400 steps a second: a free whisker's frequency and decrement come out within 5 % of the damped oscillator's
#: (the implicit integrator adds damping of the order of the step), 16 steps make a frame of 40 ms.
TIME_STEP = 0.0025
#: The ground planes are laid anew every 10 ms: a tip has then slid 1.5 mm, on a surface that curves by 1 mm over
#: 20 mm.
GROUND_STEPS = 4
#: Contacts are looked at every 5 ms: half an interval is a fifteenth of the frame.
CONTACT_STEPS = 2
#: Normal force above which a contact counts, N: a thousandth of what bends a whisker by one degree.
CONTACT_FORCE = 1e-5


class PhysicsError(RuntimeError):
    """The simulation became unstable."""


@dataclass(frozen=True, slots=True)
class ArrayReading:
    """The array as its sensors find it, one after the other.

    Attributes:
        time: when the first sensor is read, s.
        inclination: from the whisker's z-axis at that sensor's reading, shape (n,), rad.
        azimuth: from its x-axis, shape (n,), rad, in (-pi, pi].
        hinge: hinge angles about x and y, shape (n, 2), rad.
        contact: whether ground or an object presses on the rod, shape (n,).
        depth: of the deepest contact below the true surface at the last step, shape (n,), m; NaN without one.
    """

    time: float
    inclination: FloatArray
    azimuth: FloatArray
    hinge: FloatArray
    contact: BoolArray
    depth: FloatArray


class Engine(Protocol):
    """Delivers one reading of the array after the other."""

    def read(self) -> ArrayReading:
        """The next reading; each begins one frame interval after the one before, the first at time 0."""


def rod_direction(hinge: FloatArray) -> FloatArray:
    """Direction of the rod in the whisker frame, shape (..., 3), for hinge angles (..., 2): Rx(q0) Ry(q1) e_z."""
    q0, q1 = hinge[..., 0], hinge[..., 1]
    return np.stack([np.sin(q1), -np.sin(q0) * np.cos(q1), np.cos(q0) * np.cos(q1)], axis=-1)


def hinge_angles(inclination: FloatArray, azimuth: FloatArray) -> FloatArray:
    """Hinge angles about x and y, shape (..., 2), that point the rod to an inclination and azimuth; rad."""
    x, y = np.sin(inclination) * np.cos(azimuth), np.sin(inclination) * np.sin(azimuth)
    return np.stack([np.arctan2(-y, np.cos(inclination)), np.arcsin(np.clip(x, -1.0, 1.0))], axis=-1)


class PhysicsEngine:
    """MuJoCo, with the whiskers' carriers moved kinematically along a motion."""

    def __init__(
        self,
        world: World,
        layout: WhiskerLayout,
        motion: BaseMotion,
        *,
        read_offset: FloatArray,
        frame_interval: float = 0.04,
        settle_time: float = 3.0,
        mechanics: WhiskerMechanics | None = None,
        contact: ContactModel | None = None,
        time_step: float = TIME_STEP,
    ) -> None:
        """Build the model and bring the whiskers down to the ground.

        Args:
            world: ground and objects.
            layout: the array.
            motion: how the body moves; it is run from -settle_time on.
            read_offset: when each sensor is read after the frame's start, shape (n,), s, below frame_interval.
            frame_interval: time from frame to frame, s, a multiple of time_step.
            settle_time: simulated time before the first frame, s.
            mechanics: rods and joints.
            contact: contact parameters.
            time_step: of the simulation, s.
        """
        self._steps = round(frame_interval / time_step)
        if abs(self._steps * time_step - frame_interval) > 1e-9:
            raise ValueError(f"frame interval {frame_interval} s is not a multiple of the time step {time_step} s")
        if read_offset.max() >= frame_interval:
            raise ValueError(f"the last sensor is read {read_offset.max()} s after the first, frames overlap")
        self.layout, self.motion, self._dt = layout, motion, time_step
        self.model = whisker_model.build(
            world, layout, mechanics or WhiskerMechanics(), contact or ContactModel(), time_step
        )
        self.data = mujoco.MjData(self.model)
        n = layout.count
        self._qpos, self._qvel = self.data.qpos.reshape(n, 9), self.data.qvel.reshape(n, 8)
        self._force = self.data.qfrc_applied.reshape(n, 8)
        self._whisker_of_geom = np.full(self.model.ngeom, -1)
        for i in range(n):
            geom = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, f"{GEOM_PREFIX}{i}")
            self._whisker_of_geom[geom] = i
        # Angles at a sensor's reading are interpolated between the two steps around it.
        position = read_offset / time_step
        self._before = np.minimum(position.astype(np.intp), self._steps - 1)
        self._share = position - self._before
        self._nearest = np.minimum(np.round(position).astype(np.intp), self._steps - 1)
        self._ground = world.ground
        self._reach = layout.length - (mechanics or WhiskerMechanics()).radius
        self._frame = 0
        self._frame_interval = frame_interval
        self._depth = np.full(n, np.nan)
        settle_steps = round(settle_time / time_step)
        self._run(-settle_steps, settle_steps)

    def read(self) -> ArrayReading:
        """Advance by one frame interval; the reading's sensors were read during it."""
        time = self._frame * self._frame_interval
        hinge, contact = self._run(self._frame * self._steps, self._steps)
        self._frame += 1
        each = np.arange(self.layout.count)
        before, after = hinge[self._before, each], hinge[self._before + 1, each]
        angles = before + self._share[:, None] * (after - before)
        direction = rod_direction(angles)
        inclination = np.arctan2(np.hypot(direction[:, 0], direction[:, 1]), direction[:, 2])
        azimuth = np.arctan2(direction[:, 1], direction[:, 0])
        return ArrayReading(time, inclination, azimuth, angles, contact[self._nearest, each], self._depth.copy())

    def tips(self) -> FloatArray:
        """Positions of the rods' ends now, shape (n, 3), m, in the map frame."""
        base = self.motion.at([self._frame * self._frame_interval])
        p = self.layout.p_base + self.layout.length[:, None] * np.einsum(
            "nij,nj->ni", self.layout.R_base_whisker, rod_direction(self._qpos[:, 7:])
        )
        tips: FloatArray = base.position[0] + p @ base.R[0].T
        return tips

    def _run(self, first: int, count: int) -> tuple[FloatArray, BoolArray]:
        """Do `count` steps from step number `first`.

        Returns:
            Hinge angles at the beginning of each step and at the end of the last, shape (count + 1, n, 2);
            contact at the beginning of each step, shape (count, n).
        """
        carriers = carrier_states(self.motion.at((first + np.arange(count)) * self._dt), self.layout)
        hinge = np.empty((count + 1, self.layout.count, 2))
        contact = np.zeros((count, self.layout.count), dtype=np.bool_)
        for k in range(count):
            self._qpos[:, :7] = carriers.pose[k]
            self._qvel[:, :6] = carriers.velocity[k]
            # The force that moves so heavy a body as wanted lets the rods feel the acceleration during the step.
            self._force[:, :6] = CARRIER_MASS * carriers.acceleration[k]
            hinge[k] = self._qpos[:, 7:]
            if k % GROUND_STEPS == 0:
                self._place_ground(carriers.pose[k, :, :3], carriers.R[k], hinge[k])
            mujoco.mj_step(self.model, self.data)
            if k % CONTACT_STEPS == 0:
                self._note_contacts(contact[k : k + CONTACT_STEPS])
        hinge[count] = self._qpos[:, 7:]
        warnings = self.data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number
        if warnings or not np.isfinite(hinge[count]).all():
            raise PhysicsError(f"the physics became unstable at {self.data.time:.3f} s of simulated time")
        return hinge, contact

    def _place_ground(self, p_mount: FloatArray, R_map_whisker: FloatArray, hinge: FloatArray) -> None:
        """Lay each whisker's ground plane tangent to the ground under the centre of its rounded tip."""
        direction = np.einsum("nij,nj->ni", R_map_whisker, rod_direction(hinge))
        under = p_mount + self._reach[:, None] * direction
        under[:, 2], normal = self._ground.height_and_normal(under[:, 0], under[:, 1])
        self.data.mocap_pos[:] = under
        # The shortest turn of the plane's z-axis to the normal; MuJoCo normalises it.
        self.data.mocap_quat[:, 0] = 1.0 + normal[:, 2]
        self.data.mocap_quat[:, 1] = -normal[:, 1]
        self.data.mocap_quat[:, 2] = normal[:, 0]

    def _note_contacts(self, contact: BoolArray) -> None:
        """Mark whiskers that ground or an object presses on, and how deep; each contact's first row is normal."""
        found = self.data.contact
        if not self.data.ncon:
            return
        whisker = self._whisker_of_geom[found.geom]
        outside = (whisker < 0).any(axis=1) & (found.efc_address >= 0)
        if not outside.any():
            return
        who = whisker[outside].max(axis=1)
        pressed = self.data.efc_force[found.efc_address[outside]] > CONTACT_FORCE
        contact[:, who[pressed]] = True
        self._depth[:] = np.nan
        np.fmax.at(self._depth, who, -found.dist[outside])
