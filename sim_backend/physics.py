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
from sim_backend.carriers import Carriers
from sim_backend.contact_log import CONTACT_STEPS, ContactLog
from sim_backend.ground_contacts import GroundContacts
from sim_backend.rod_drag import RodDrag
from sim_backend.touch_surface import SampledHeight, SmoothHeight
from sim_backend.whisker_model import CARRIER_MASS, ContactModel, WhiskerMechanics
from sim_backend.world import World

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: 250 steps a second, 10 to a frame of 40 ms: a free whisker's frequency and decrement come out within 5 % of the
#: damped oscillator's, and contacts, whose time constant is two steps, are as firm as with shorter steps.
TIME_STEP = 0.004
#: The ground is laid anew every 20 ms: a tip has then slid 3 mm, on a surface that curves by 1 mm over 20 mm.
GROUND_STEPS = 5


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
        depth: of the deepest contact below the true surface, shape (n,), m; NaN without one.
        contact_point: where the surface presses on the rod, in the map frame, shape (n, 3), m; of several places
            the one that is pressed most; NaN without contact.
        contact_arm: how far along the rod from its joint that is, shape (n,), m, about the rod's length where its
            end touches; NaN without contact.
    """

    time: float
    inclination: FloatArray
    azimuth: FloatArray
    hinge: FloatArray
    contact: BoolArray
    depth: FloatArray
    contact_point: FloatArray
    contact_arm: FloatArray


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
            world: ground and objects, or floor and walls.
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
        rod = mechanics or WhiskerMechanics()
        reach = layout.length - rod.radius
        if world.walls is not None:
            self._ground = GroundContacts(world.walls, reach)
        else:
            quick = SampledHeight(world.ground.height, world.ground.extent)
            self._ground = GroundContacts(SmoothHeight(world.ground), reach, quick)
        self.model = whisker_model.build(
            world, layout, rod, contact or ContactModel(), time_step, parts=self._ground.parts
        )
        self.data = mujoco.MjData(self.model)
        n = layout.count
        self._carriers = Carriers(layout)
        self._qpos, self._qvel = self.data.qpos.reshape(n, 9), self.data.qvel.reshape(n, 8)
        self._force = self.data.qfrc_applied.reshape(n, 8)
        self._damping = self.model.dof_damping.reshape(n, 8)
        self._dry_damping = self._damping[:, 6:].copy()
        self._water: RodDrag | None = None
        if world.water is not None:
            self._water = RodDrag(world.water, layout.length, rod.radius)
            self.model.dof_armature.reshape(n, 8)[:, 6:] += self._water.added_inertia[:, None]
            mujoco.mj_setConst(self.model, self.data)
        self._contacts = ContactLog(self.model, n)
        # Angles at a sensor's reading are interpolated between the two steps around it.
        position = read_offset / time_step
        self._before = np.minimum(position.astype(np.intp), self._steps - 1)
        self._share = position - self._before
        self._contact_row = np.minimum(np.round(position).astype(np.intp), self._steps - 1) // CONTACT_STEPS
        self._frame = 0
        self._frame_interval = frame_interval
        settle_steps = round(settle_time / time_step)
        self._run(-settle_steps, settle_steps)

    def read(self) -> ArrayReading:
        """Advance by one frame interval; the reading's sensors were read during it."""
        time = self._frame * self._frame_interval
        joint, hinge = self._run(self._frame * self._steps, self._steps)
        self._frame += 1
        each = np.arange(self.layout.count)
        before, after = hinge[self._before, each], hinge[self._before + 1, each]
        angles = before + self._share[:, None] * (after - before)
        direction = rod_direction(angles)
        inclination = np.arctan2(np.hypot(direction[:, 0], direction[:, 1]), direction[:, 2])
        azimuth = np.arctan2(direction[:, 1], direction[:, 0])
        contact, depth, point = self._contacts.at(self._contact_row)
        arm = np.sqrt(np.square(point - joint[self._contact_row * CONTACT_STEPS, each]).sum(axis=-1))
        return ArrayReading(time, inclination, azimuth, angles, contact, depth, point, arm)

    def tips(self) -> FloatArray:
        """Positions of the rods' ends now, shape (n, 3), m, in the map frame."""
        base = self.motion.at([self._frame * self._frame_interval])
        p = self.layout.p_base + self.layout.length[:, None] * np.einsum(
            "nij,nj->ni", self.layout.R_base_whisker, rod_direction(self._qpos[:, 7:])
        )
        tips: FloatArray = base.position[0] + p @ base.R[0].T
        return tips

    def _run(self, first: int, count: int) -> tuple[FloatArray, FloatArray]:
        """Do `count` steps from step number `first`.

        Returns:
            Positions of the joints at the beginning of each step, shape (count, n, 3), m; hinge angles then and at
            the end of the last step, shape (count + 1, n, 2), rad.
        """
        carriers = self._carriers.at(self.motion.at((first + np.arange(count)) * self._dt))
        hinge = np.empty((count + 1, self.layout.count, 2))
        # The force that moves so heavy a body as wanted lets the rods feel the acceleration during the step.
        force = CARRIER_MASS * carriers.acceleration
        self._contacts.clear()
        for k in range(count):
            self._qpos[:, :7] = carriers.pose[k]
            self._qvel[:, :6] = carriers.velocity[k]
            self._force[:, :6] = force[k]
            hinge[k] = self._qpos[:, 7:]
            if k % GROUND_STEPS == 0:
                direction = np.matmul(carriers.R[k], rod_direction(hinge[k])[:, :, None])[:, :, 0]
                self._ground.place(carriers.pose[k, :, :3].T, direction.T)
                self.data.mocap_pos[:] = self._ground.position.reshape(-1, 3)
                self.data.mocap_quat[:] = self._ground.quaternion.reshape(-1, 4)
                if self._water is not None:
                    # The integrator takes damping implicitly: as a force, held for some steps, it would overshoot.
                    self._force[:, 6:], damping = self._water.on_hinges(
                        (first + k) * self._dt,
                        carriers.pose[k, :, :3],
                        carriers.R[k],
                        carriers.velocity[k],
                        hinge[k],
                        self._qvel[:, 6:],
                    )
                    self._damping[:, 6:] = self._dry_damping + damping
            mujoco.mj_step(self.model, self.data)
            if k % CONTACT_STEPS == 0:
                self._contacts.note(self.data)
        hinge[count] = self._qpos[:, 7:]
        warnings = self.data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number
        if warnings or not np.isfinite(hinge[count]).all():
            raise PhysicsError(f"the physics became unstable at {self.data.time:.3f} s of simulated time")
        return carriers.pose[:, :, :3], hinge
