"""Calibration from the floor: the level array lowered on a flat plate and dragged, all whiskers at once.

For every direction, the array starts free above the plate, comes down while it moves, so that the rods trail, and is
then dragged and lowered step by step without turning back. At the end of every drag it is held for some frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.samples import FloorFrames
from robominer_slam.layout import WhiskerLayout
from sim_backend.base_motion import BaseStates
from sim_backend.ground import HeightField
from sim_backend.magnet import HallArray
from sim_backend.physics import Engine, PhysicsEngine
from sim_backend.quasi_static import QuasiStaticEngine
from sim_backend.random_streams import stream
from sim_backend.scene import World
from sim_backend.touch_surface import Part
from sim_backend.whisker_model import WhiskerMechanics

FloatArray = NDArray[np.float64]

FRAME_INTERVAL = 0.04


@dataclass(frozen=True, slots=True)
class FloorProcedure:
    """What the operator does.

    Attributes:
        inclinations_deg: of the rods, for which the heights are set.
        directions_deg: of the drags, from base_link's x-axis.
        drag: at every height, m.
        sink: how far the array moves while it is lowered to the next height, m.
        speed: mean, m/s.
        hold_frames: frames taken at the end of every drag.
        height_error: of the heights as written down, one standard deviation, m (spacers under the frame).
        direction_error: of the directions as written down, one standard deviation, rad.
        clearance: of free rods over the plate, m.
    """

    inclinations_deg: tuple[float, ...] = (12.0, 22.0, 33.0, 44.0, 56.0, 70.0)
    directions_deg: tuple[float, ...] = tuple(np.arange(-180.0, 180.0, 45.0).tolist())
    drag: float = 0.06
    sink: float = 0.03
    speed: float = 0.1
    hold_frames: int = 5
    height_error: float = 0.0002
    direction_error: float = float(np.deg2rad(0.5))
    clearance: float = 0.02


class FloorMotion:
    """A level body led from point to point, at rest in each: see `base_motion.BaseMotion`."""

    def __init__(self, points: FloatArray, arrival: FloatArray) -> None:
        """Points, shape (k, 3), m, and when each is reached, shape (k,), s, rising from 0."""
        self._points, self._arrival = points, arrival

    @property
    def duration(self) -> float:
        """When the last point is reached, s."""
        return float(self._arrival[-1])

    @property
    def length(self) -> float:
        """Length of the way, m."""
        return float(np.linalg.norm(np.diff(self._points, axis=0), axis=1).sum())

    def at(self, time: ArrayLike) -> BaseStates:
        """The body's motion at times of shape (n,), s: from rest to rest, 3 u^2 - 2 u^3."""
        t = np.clip(np.atleast_1d(np.asarray(time, dtype=np.float64)), 0.0, self.duration)
        k = np.clip(np.searchsorted(self._arrival, t, side="right") - 1, 0, len(self._arrival) - 2)
        span = (self._arrival[k + 1] - self._arrival[k])[:, None]
        u = (t - self._arrival[k])[:, None] / span
        way = self._points[k + 1] - self._points[k]
        n = len(t)
        return BaseStates(
            self._points[k] + (3.0 - 2.0 * u) * u * u * way,
            np.broadcast_to(np.eye(3), (n, 3, 3)),
            6.0 * u * (1.0 - u) / span * way,
            (6.0 - 12.0 * u) / span**2 * way,
            np.zeros((n, 3)),
            np.zeros((n, 3)),
        )


class FlatPlate:
    """The plane z = 0: see `touch_surface.Surface`."""

    def gap(self, p: FloatArray) -> Part:
        """Height over the plate, and up."""
        up = np.zeros_like(p)
        up[2] = 1.0
        return p[2].copy(), up

    def parts(self, p: FloatArray) -> tuple[Part, ...]:
        """See `Surface.parts`."""
        return (self.gap(p),)


@dataclass(frozen=True, slots=True)
class _Hold:
    """A stop: when, at which height, in which direction, how far dragged."""

    start: float
    height: float
    direction: float
    dragged: float


def floor_capture(
    layout: WhiskerLayout,
    seed: int,
    *,
    procedure: FloorProcedure | None = None,
    engine: str = "quasi-static",
    hall: HallArray | None = None,
) -> FloorFrames:
    """Frames of the array that `seed` stands for, with noise and quantisation, labelled as an operator would.

    Args:
        layout: the array; its floor whiskers touch.
        seed: of tolerances, noise and the labels' errors.
        procedure: what is done.
        engine: `quasi-static`, or `physics` for rods that swing.
        hall: the sensors; those of the seed by default.

    Raises:
        ValueError: no such engine.
    """
    steps, array, rng = procedure or FloorProcedure(), hall or HallArray(layout, seed), stream(seed, "floor capture")
    mechanics = WhiskerMechanics()
    reach = float(layout.length.max()) - mechanics.radius
    motion, holds = _way(steps, reach, mechanics.radius)
    device = _engine(engine, layout, motion, mechanics)
    hinges, labels = [], []
    pending = list(holds)
    for k in range(round(motion.duration / FRAME_INTERVAL)):
        reading = device.read()
        time = k * FRAME_INTERVAL
        if pending and time >= pending[0].start + steps.hold_frames * FRAME_INTERVAL:
            pending.pop(0)
        if pending and time >= pending[0].start:
            hinges.append(reading.hinge)
            labels.append(pending[0])
    field = array.sample(array.field(np.array(hinges), np.broadcast_to(np.eye(3), (len(hinges), 3, 3))), rng)
    height = np.array([label.height for label in labels])
    direction = np.array([label.direction for label in labels])
    noted_height = height + _shared(height, rng, steps.height_error)
    return FloorFrames(
        np.where(height > reach + mechanics.radius, height, noted_height),
        direction + _shared(direction, rng, steps.direction_error),
        np.array([label.dragged for label in labels]),
        field,
        np.broadcast_to(layout.present, field.shape[:2]).copy(),
        mechanics.radius,
    )


def _shared(values: FloatArray, rng: np.random.Generator, sigma: float) -> FloatArray:
    """Errors, the same wherever the value is the same: a spacer is as wrong each time."""
    distinct, which = np.unique(values, return_inverse=True)
    error: FloatArray = rng.normal(0.0, sigma, len(distinct))[which.reshape(-1)]
    return error


def _way(steps: FloorProcedure, reach: float, radius: float) -> tuple[FloorMotion, list[_Hold]]:
    free = reach + radius + steps.clearance
    heights = [radius + reach * float(np.cos(np.deg2rad(each))) for each in steps.inclinations_deg]
    pause = (steps.hold_frames + 3) * FRAME_INTERVAL
    points, times, holds = [np.array([0.0, 0.0, free])], [0.0], []

    def go(point: FloatArray) -> None:
        way = float(np.linalg.norm(point - points[-1]))
        times.append(times[-1] + max(way / steps.speed, FRAME_INTERVAL))
        points.append(point)

    def stay() -> None:
        times.append(times[-1] + pause)
        points.append(points[-1])

    for degrees in steps.directions_deg:
        direction = float(np.deg2rad(degrees))
        ahead = np.array([np.cos(direction), np.sin(direction), 0.0])
        go(np.array([0.0, 0.0, free]))
        # Rods that swing come to rest first.
        stay()
        holds.append(_Hold(times[-1] - steps.hold_frames * FRAME_INTERVAL, free, direction, 0.0))
        at, dragged = 0.0, 0.0
        for height in heights:
            at += steps.sink
            go(at * ahead + [0.0, 0.0, height])
            at, dragged = at + steps.drag, dragged + steps.sink * (dragged > 0.0) + steps.drag
            go(at * ahead + [0.0, 0.0, height])
            holds.append(_Hold(times[-1] + FRAME_INTERVAL, height, direction, dragged))
            stay()
        go((at + steps.sink) * ahead + [0.0, 0.0, free])
    assert all(b > a for a, b in pairwise(times))
    return FloorMotion(np.array(points), np.array(times)), holds


def _engine(name: str, layout: WhiskerLayout, motion: FloorMotion, mechanics: WhiskerMechanics) -> Engine:
    read_offset = np.zeros(layout.count)
    if name == "quasi-static":
        return QuasiStaticEngine(FlatPlate(), layout, motion, read_offset=read_offset, mechanics=mechanics)
    if name != "physics":
        raise ValueError(f"no engine is called {name!r}, expected quasi-static or physics")
    cell, nodes = 0.1, 41
    plate = HeightField((-2.0, -2.0), cell, np.zeros((nodes, nodes)))
    world = World("plate", plate, (), {1: np.zeros((1, 3))}, layout=layout.name)
    return PhysicsEngine(world, layout, motion, read_offset=read_offset, mechanics=mechanics)
