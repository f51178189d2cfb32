"""Quasi-static engine: tips laid on the surface by geometry and dragged along it, without time steps of a physics.

A rod is rigid, so a touching tip has one freedom: along the curve in which the sphere around its mount meets the
surface. Inertia is left out. What then moves the tip along that curve is the balance of the joint's spring, the
surface's pressure and Coulomb's friction, derived here for a rod in direction d that touches a surface of normal n:

- t = d x n points along the curve, b = d - (n.d) n outward in the surface; q = |d x n|.
- Across the curve: F.e + N q - mu N c (b.e) = 0 gives the pressure N; e = (n - (n.d) d) / q, b.e = -(n.d), c = -1
  where the tip is dragged and +1 where it is pushed.
- Along it, neither pressure nor the rod pulls: F.t = mu N v_t / |v|. On flat ground F.t = 0, and the tip follows
  its mount on a tractrix; on a slope it slides sideways as well, and where F.t exceeds mu N, it slips.

F is the spring's force, towards the rest direction. Whiskers do not touch each other here, and only their ends
touch the surface.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.layout import WhiskerLayout
from sim_backend.base_motion import BaseMotion
from sim_backend.physics import ArrayReading
from sim_backend.rod_drag import BentRods
from sim_backend.touch_surface import Surface
from sim_backend.water import Water
from sim_backend.whisker_model import WhiskerMechanics

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Frames computed at once where one does not depend on the other.
BLOCK = 50
#: Longest move of a projection, m: beyond, the surface is not what its slope promised.
LONGEST_MOVE = 0.03
#: What a projection may leave, m, before the tip is laid down anew.
TOLERANCE = 0.002
#: Farthest slip to the side per frame, m: a tip that slips for good gets where it goes within a few frames.
LONGEST_SLIP = 0.01
#: Share of the friction that no rod lacks from one side: one pushed exactly in line would never turn over.
CROOKED = 0.00002
#: Inclinations at which a falling rod is looked at, from lying to hanging, rad.
FALL = np.deg2rad(np.arange(84.0, -0.1, -2.0))
GRAVITY = 9.81


class QuasiStaticEngine:
    """Lays the array's tips on a surface, frame by frame; each whisker at the time at which it is read."""

    def __init__(
        self,
        surface: Surface,
        layout: WhiskerLayout,
        motion: BaseMotion,
        *,
        read_offset: FloatArray,
        frame_interval: float = 0.04,
        settle_time: float = 3.0,
        mechanics: WhiskerMechanics | None = None,
        friction: float = 0.3,
        water: Water | None = None,
    ) -> None:
        """Bring the whiskers down to the surface.

        Args:
            surface: what the tips lie on.
            layout: the array, of any mount directions.
            motion: how the body moves; it is run from -settle_time on.
            read_offset: when each sensor is read after the frame's start, shape (n,), s, below frame_interval.
            frame_interval: time from frame to frame, s.
            settle_time: simulated time before the first frame, s.
            mechanics: rods and joints; a free rod sags by its weight against the stiffness.
            friction: Coulomb's coefficient.
            water: that the rods move through.
        """
        if read_offset.max() >= frame_interval:
            raise ValueError(f"the last sensor is read {read_offset.max()} s after the first, frames overlap")
        self.layout, self.motion = layout, motion
        self._surface, self._friction = surface, friction
        self._interval, self._share = frame_interval, (read_offset / frame_interval)[:, None]
        rod = mechanics or WhiskerMechanics()
        self._radius = rod.radius
        self._reach = layout.length - rod.radius
        self._reach_squared = self._reach**2
        self._sag = rod.mass * GRAVITY * layout.length / 2.0 / rod.stiffness
        self._water = None if water is None else BentRods(water, layout.length, rod, frame_interval)
        n = layout.count
        self._touching = np.zeros(n, dtype=np.bool_)
        self._tip = self._mount = self._gradient = np.full((3, n), np.nan)
        self._gap = np.full(n, np.nan)
        # Every other whisker a little to the left, the rest to the right.
        self._crooked = np.where(np.arange(n) % 2 == 0, CROOKED, -CROOKED)
        self._frame_is_even = False
        self._side = np.zeros((3, n))  # move to the side that the balance asks for in the next frame
        self._next = -round(settle_time / frame_interval)
        self._ready: list[ArrayReading] = []
        self._tips: list[FloatArray] = []
        self._last_tips = np.full((n, 3), np.nan)
        while self._next < 0:
            self._compute(min(BLOCK, -self._next))
        self._ready.clear()
        self._tips.clear()

    def read(self) -> ArrayReading:
        """The next reading; each begins one frame interval after the one before, the first at time 0."""
        if not self._ready:
            self._compute(BLOCK)
            self._ready.reverse()
            self._tips.reverse()
        self._last_tips = self._tips.pop()
        return self._ready.pop()

    def tips(self) -> FloatArray:
        """Positions of the rods' ends in the last reading, each when it was read, shape (n, 3), m, map frame."""
        return self._last_tips

    def _compute(self, frames: int) -> None:
        """Append the readings of the next frames."""
        first = self._next
        self._next += frames
        base = self.motion.at((first + np.arange(frames + 1)) * self._interval)
        at_start = base.position[:, None, :] + self.layout.p_base @ base.R.transpose(0, 2, 1)
        mount = at_start[:-1] + self._share * (at_start[1:] - at_start[:-1])
        R_base = base.R[:-1, None] + self._share[:, :, None] * (base.R[1:] - base.R[:-1])[:, None]
        R = R_base @ self.layout.R_base_whisker
        rest = R[..., 2].copy()
        # A rod that hangs free has turned from its mount's direction towards straight down.
        if self._water is not None:
            time = (first + np.arange(frames)[:, None] + self._share[:, 0]) * self._interval
            velocity = (at_start[1:] - at_start[:-1]) / self._interval
            rest += self._water.hang(time, mount, velocity, base.omega[:-1], rest)
        rest[..., 2] -= self._sag
        rest /= np.sqrt(np.square(rest).sum(axis=-1, keepdims=True))
        mount_T = np.ascontiguousarray(mount.transpose(0, 2, 1))
        hanging = mount_T + self._reach * rest.transpose(0, 2, 1)
        value, G = self._surface.gap(np.ascontiguousarray(hanging.swapaxes(0, 1)).reshape(3, -1))
        blocked = (value < self._radius * np.sqrt(_dot(G, G))).reshape(frames, -1)
        if np.isnan(self._gap[0]):
            self._tip, self._mount = hanging[0], mount_T[0]
            self._gap, self._gradient = self._surface.gap(self._tip)
        tips = np.empty((frames, 3, self.layout.count))
        touching = np.empty((frames, self.layout.count), dtype=np.bool_)
        gaps, gradient = np.empty((frames, self.layout.count)), np.empty((frames, 3, self.layout.count))
        for k in range(frames):
            self._frame_of_block = k
            self._step(mount_T[k], R[k], hanging[k], blocked[k])
            tips[k], touching[k] = self._tip, self._touching
            gaps[k], gradient[k] = self._gap, self._gradient
        self._append(first, mount, R, tips, touching, gaps, gradient)

    def _append(
        self,
        first: int,
        mount: FloatArray,
        R: FloatArray,
        tips: FloatArray,
        touching: BoolArray,
        gaps: FloatArray,
        gradient: FloatArray,
    ) -> None:
        steep = np.sqrt(np.square(gradient).sum(axis=1))
        normal = gradient / steep[:, None]
        along = tips.transpose(0, 2, 1) - mount
        d = (R.swapaxes(-1, -2) @ along[..., None])[..., 0]
        d /= np.sqrt(np.square(d).sum(axis=-1, keepdims=True))
        inclination = np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2])
        azimuth = np.arctan2(d[..., 1], d[..., 0])
        # The direction is Rx(q0) Ry(q1) e_z, as in `physics.rod_direction`.
        hinge = np.stack([np.arctan2(-d[..., 1], d[..., 2]), np.arcsin(np.clip(d[..., 0], -1.0, 1.0))], axis=-1)
        depth = np.where(touching, self._radius - gaps / steep, np.nan)
        point = np.where(touching[..., None], (tips - self._radius * normal).transpose(0, 2, 1), np.nan)
        arm = np.sqrt(np.square(point - mount).sum(axis=-1))
        ends = mount + along * (self.layout.length / self._reach)[:, None]
        for k in range(len(tips)):
            time = (first + k) * self._interval
            self._ready.append(
                ArrayReading(time, inclination[k], azimuth[k], hinge[k], touching[k], depth[k], point[k], arm[k])
            )
            self._tips.append(ends[k])

    def _step(self, mount: FloatArray, R: FloatArray, hanging: FloatArray, blocked: BoolArray) -> None:
        """Move every tip to where it is in the next frame.

        Args:
            mount: positions of the mounts, shape (3, n), m.
            R: rotations, whisker frame to map, shape (n, 3, 3).
            hanging: where the ends of free rods hang, shape (3, n), m.
            blocked: whether the surface is in the way of hanging, shape (n,).
        """
        before, tip = self._tip, self._tip + self._side
        gap, G = self._gap + np.add.reduce(self._gradient * self._side), self._gradient
        tip = self._project(tip, mount, gap, G)
        gap, G = self._surface.gap(tip)
        steep = np.sqrt(_dot(G, G))
        off = np.abs(gap - self._radius * steep) > TOLERANCE * steep
        held = self._touching
        self._frame_is_even = not self._frame_is_even
        if self._frame_is_even:
            held = held & self._balance(tip - before, (tip - mount) / self._reach, G / steep, R)
        touching: BoolArray = held & ~off
        if np.count_nonzero(touching) < len(touching):
            fresh = ~touching & (blocked | held)
            tip = np.where(touching | fresh, tip, hanging)
            who = np.flatnonzero(fresh)
            if len(who):
                touching[who] = self._lay_down(who, mount, (hanging[:, who] - mount[:, who]) / self._reach[who], tip)
            self._side = self._side * (held & ~off)
            gap, G = self._surface.gap(tip)
        self._tip, self._touching, self._mount, self._gap, self._gradient = tip, touching, mount, gap, G

    def _project(self, tip: FloatArray, mount: FloatArray, gap: FloatArray, G: FloatArray) -> FloatArray:
        """One Newton step to the nearest point that lies on both the sphere around the mount and the surface."""
        d = tip - mount
        GG, Gd, dd = _dot(G, G), _dot(G, d), _dot(d, d)
        gap = gap - self._radius * np.sqrt(GG)
        short = 0.5 * (dd - self._reach_squared)
        # Upright on the surface, the two directions are one: the added share keeps the step finite.
        determinant = GG * dd * 1.0001 - Gd * Gd
        move = ((Gd * short - dd * gap) / determinant) * G
        move += ((Gd * gap - GG * short) / determinant) * d
        length = np.sqrt(_dot(move, move))
        move *= np.minimum(1.0, LONGEST_MOVE / (length + 1e-12))
        move += tip
        return move

    def _force(self, d: FloatArray, R: FloatArray) -> FloatArray:
        """Force on the rod's end by the springs of both hinges and the rod's weight over stiffness / length.

        The hinges' energy is (q0^2 + q1^2) / 2, which is not the same for all azimuths of an inclination: a rod
        that trails along its x or y axis is held there. Force across the rod counts, along it anything goes.
        """
        local = (d.T[:, None, :] @ R)[:, 0, :].T
        x, y, z = local
        cos2 = np.maximum(1.0 - x * x, 1e-4)
        q0 = np.arctan2(-y, z) / cos2
        pull = np.empty_like(d)
        pull[0] = -np.arcsin(np.clip(x, -1.0, 1.0)) / np.sqrt(cos2)
        pull[1] = q0 * z
        pull[2] = -q0 * y
        force = (R @ pull.T[:, :, None])[:, :, 0].T
        force[2] -= self._sag
        return force

    def _balance(self, moved: FloatArray, d: FloatArray, n: FloatArray, R: FloatArray) -> BoolArray:
        """Find how far the forces along the curve move each tip per frame (module's docstring).

        Args:
            moved: of the tip in this frame, shape (3, n), m.
            d, n: directions of rod and surface's normal, shape (3, n).
            R: rotations, whisker frame to map, shape (n, 3, 3).

        Returns:
            Whether the spring presses the tip onto the surface, shape (n,).
        """
        force, nd = self._force(d, R), _dot(n, d)
        if self._water is not None:
            force += self._water.push(self._frame_of_block, d)
        press = _dot(force, n) - _dot(force, d) * nd  # q F.e
        t = np.empty_like(d)
        t[0] = d[1] * n[2] - d[2] * n[1]
        t[1] = d[2] * n[0] - d[0] * n[2]
        t[2] = d[0] * n[1] - d[1] * n[0]
        q2 = np.maximum(1.0 - nd * nd, 1e-4)
        q = np.sqrt(q2)
        outward = _dot(moved, d) - nd * _dot(moved, n)  # times q
        resisting = np.maximum(q + self._friction * np.sign(outward) * nd, 0.05)
        share = _dot(force, t) * resisting / (-self._friction * np.minimum(press, -1e-6))
        share += self._crooked
        within = np.minimum(np.maximum(share, -0.95), 0.95)
        far = np.abs(outward) * within / np.sqrt((1.0 - within * within) * q2)
        far += LONGEST_SLIP * (share - np.minimum(np.maximum(share, -1.0), 1.0))
        t *= np.minimum(np.maximum(far, -LONGEST_SLIP), LONGEST_SLIP) / q
        self._side = t
        pressed: BoolArray = press < 0.0
        return pressed

    def _lay_down(self, who: NDArray[np.intp], mount: FloatArray, z: FloatArray, tip: FloatArray) -> BoolArray:
        """Let rods that have lost the surface, or meet it, fall from lying to the first touch, trailing.

        Args:
            who: the rods, shape (m,).
            mount: of all rods, shape (3, n), m.
            z: directions in which these rods hang, shape (3, m).
            tip: of all rods, shape (3, n), m; those of these rods are changed.

        Returns:
            Which of these rods touch now, shape (m,).
        """
        # Trailing: as the rod lay before, or against the mount's motion.
        lay = np.where(self._touching[who], self._tip[:, who], self._mount[:, who]) - mount[:, who]
        lay[0] -= 1e-9
        lay -= _dot(lay, z) * z
        lay /= np.maximum(np.sqrt(_dot(lay, lay)), 1e-12)
        reach = self._reach[who]
        angle = FALL[:, None]
        p = mount[:, None, who] + reach * (np.cos(angle) * z[:, None, :] + np.sin(angle) * lay[:, None, :])
        value, G = self._surface.gap(p.reshape(3, -1))
        above = value.reshape(p.shape[1:]) - self._radius * np.sqrt(_dot(G, G)).reshape(p.shape[1:])
        fallen = above < 0.0
        touched: BoolArray = np.logical_or.reduce(fallen)
        first, each = np.maximum(fallen.argmax(axis=0), 1), np.arange(len(who))
        before, after = np.maximum(above[first - 1, each], 0.0), above[first, each]
        share = np.where(touched, before / np.maximum(before - after, 1e-9), 0.0)
        tip[:, who] = np.where(
            touched, p[:, first - 1, each] + share * (p[:, first, each] - p[:, first - 1, each]), p[:, -1, each]
        )
        return touched


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Scalar products of the columns of (3, n)."""
    product: FloatArray = np.add.reduce(a * b)
    return product
