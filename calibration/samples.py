"""Samples of the three ways to know the truth: a jig, ring plates, and the floor; and what each says of the rod.

All become `Pose` rows: an inclination and an azimuth with their standard deviations. An unknown azimuth has an
infinite one, and the fit solves for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.polynomial import FloatArray

#: How well a jig holds its angles, rad.
JIG_SIGMA = float(np.deg2rad(0.1))
#: A rod in a ring's hole has some play, rad.
RING_SIGMA = float(np.deg2rad(0.3))
#: How well the height over the plate is known, m.
HEIGHT_SIGMA = 0.0003
#: Spread of the azimuth against the drag's direction: friction and the hinges' stiffness hold a rod aside, rad
#: (field notes: 2.8 deg in the median on rough ground).
DRAG_SIGMA = float(np.deg2rad(2.5))
#: How straight down a free rod hangs, rad.
FREE_SIGMA = float(np.deg2rad(0.1))


class FitError(ValueError):
    """Data that cannot be fitted; the message names the whisker and what is missing."""


class ArrayGeometry(Protocol):
    """What a fit needs to know of the array; `robominer_slam.layout.WhiskerLayout` is one."""

    @property
    def name(self) -> str:
        """The layout's name."""

    @property
    def rows(self) -> int:
        """Rows of the array."""

    @property
    def cols(self) -> int:
        """Whiskers in a row."""

    @property
    def p_base(self) -> FloatArray:
        """Positions of the joints in base_link, shape (n, 3), m."""

    @property
    def R_base_whisker(self) -> FloatArray:
        """Mount rotations, whisker frame to base_link, shape (n, 3, 3)."""

    @property
    def length(self) -> FloatArray:
        """Rod lengths, shape (n,), m."""

    @property
    def present(self) -> NDArray[np.bool_]:
        """False where the array has a hole, shape (n,)."""


@dataclass(frozen=True, slots=True)
class JigSamples:
    """Samples of whiskers in a jig: shape (m,) each and (m, 3) for the field.

    Samples with the same number in `frame` were read at once, all those whiskers deflected; None or -1 says that
    one whisker was deflected at a time, all others at rest.
    """

    row: NDArray[np.intp]
    col: NDArray[np.intp]
    inclination: FloatArray
    azimuth: FloatArray
    field_mT: FloatArray
    frame: NDArray[np.intp] | None = None

    @classmethod
    def from_rows(cls, rows: Sequence[Sequence[float]]) -> JigSamples:
        """Rows of row, col, inclination_deg, azimuth_deg, bx_mT, by_mT, bz_mT.

        Raises:
            FitError: no rows, or a value that is not finite.
        """
        table = np.asarray(rows, dtype=np.float64).reshape(-1, 7)
        if not len(table):
            raise FitError("the jig table has no rows")
        if not np.isfinite(table).all():
            line = int(np.flatnonzero(~np.isfinite(table).all(axis=1))[0])
            raise FitError(f"the jig table's row {line + 1} has a value that is not finite")
        return cls(
            table[:, 0].astype(np.intp),
            table[:, 1].astype(np.intp),
            np.deg2rad(table[:, 2]),
            np.deg2rad(table[:, 3]),
            table[:, 4:7],
        )


@dataclass(frozen=True, slots=True)
class RingSamples:
    """Samples of whiskers led around in ring plates: shape (m,) each and (m, 3) for the field.

    A plate's hole holds the rod at `inclination`; 0 is a whisker at rest. `azimuth` is NaN where nobody knows it;
    a few known ones (the operator's touches in the wizard) fix what the sensor's rotation about the rod leaves
    open, `azimuth_sigma` says how well. `frame` as with `JigSamples`.
    """

    row: NDArray[np.intp]
    col: NDArray[np.intp]
    inclination: FloatArray
    azimuth: FloatArray
    field_mT: FloatArray
    azimuth_sigma: float = float(np.deg2rad(10.0))
    frame: NDArray[np.intp] | None = None


@dataclass(frozen=True, slots=True)
class FloorFrames:
    """Frames of the whole array, held level over a flat plate and dragged.

    Attributes:
        height: of the joints over the plate, shape (m,), m; above the rods' length nothing touches.
        direction: of the drag in base_link, from its x-axis, shape (m,), rad.
        dragged: how far the array was dragged in this direction since the rods were last free, shape (m,), m.
        field_mT: shape (m, n, 3), mT.
        valid: shape (m, n), as the device says.
        tip_radius: of the rods' rounded tips, m.
    """

    height: FloatArray
    direction: FloatArray
    dragged: FloatArray
    field_mT: FloatArray
    valid: NDArray[np.bool_]
    tip_radius: float = 0.0015


Samples = JigSamples | RingSamples | FloorFrames


@dataclass(frozen=True, slots=True)
class Pose:
    """What is known of a rod, for m samples of single whiskers.

    Attributes:
        whisker: place in the array, row-major, shape (m,).
        inclination, inclination_sigma: shape (m,), rad.
        azimuth, azimuth_sigma: shape (m,), rad; infinite sigma where it is unknown.
        field_mT: shape (m, 3), mT.
        setting: samples of one setting share its error, so that cross-validation holds them out together, (m,).
        frame: which frame of the whole array a sample belongs to, -1 where the other whiskers rest, (m,).
    """

    whisker: NDArray[np.intp]
    inclination: FloatArray
    inclination_sigma: FloatArray
    azimuth: FloatArray
    azimuth_sigma: FloatArray
    field_mT: FloatArray
    setting: NDArray[np.intp]
    frame: NDArray[np.intp]

    def kept(self, mask: NDArray[np.bool_]) -> Pose:
        """The samples for which the mask, shape (m,), is True."""
        return Pose(*(getattr(self, name)[mask] for name in Pose.__slots__))


def poses(samples: Sequence[Samples], rows: int, cols: int, layout: ArrayGeometry | None) -> Pose:
    """All samples of all sources as one table.

    Raises:
        FitError: samples outside the array, frames of another size, floor frames without a layout.
    """
    tables: list[Pose] = []
    settings = frames = 0
    for each in samples:
        if isinstance(each, FloorFrames):
            table = _floor_poses(each, rows, cols, layout)
        else:
            table = _single_poses(each, rows, cols)
        frame = np.where(table.frame < 0, -1, table.frame + frames)
        tables.append(
            Pose(table.whisker, table.inclination, table.inclination_sigma, table.azimuth, table.azimuth_sigma,
                 table.field_mT, table.setting + settings, frame)
        )  # fmt: skip
        settings += int(table.setting.max(initial=-1)) + 1
        frames = max(frames, int(frame.max(initial=-1)) + 1)
    if not tables or not sum(len(table.whisker) for table in tables):
        raise FitError("the capture has no samples")
    names = Pose.__slots__
    return Pose(*(np.concatenate([getattr(table, name) for table in tables]) for name in names))


def _single_poses(samples: JigSamples | RingSamples, rows: int, cols: int) -> Pose:
    outside = (samples.row < 0) | (samples.col < 0) | (samples.row >= rows) | (samples.col >= cols)
    if outside.any():
        raise FitError(f"the jig table names whiskers outside the {rows} x {cols} array")
    m = len(samples.row)
    azimuth = samples.azimuth
    if isinstance(samples, RingSamples):
        sigma = np.where(np.isfinite(azimuth), samples.azimuth_sigma, np.inf)
        azimuth = np.where(np.isfinite(azimuth), azimuth, 0.0)
        inclination_sigma = RING_SIGMA
        # A hold-out of ring samples: each by itself, the plate's inclination is shared by design.
        setting = np.arange(m)
    else:
        sigma = np.full(m, JIG_SIGMA)
        inclination_sigma = JIG_SIGMA
        rounded = np.round(np.rad2deg(np.column_stack([samples.inclination, azimuth])), 1)
        setting = np.unique(rounded, axis=0, return_inverse=True)[1].reshape(-1)
    frame = np.full(m, -1, dtype=np.intp) if samples.frame is None else samples.frame
    return Pose(
        samples.row * cols + samples.col, samples.inclination, np.full(m, inclination_sigma), azimuth, sigma,
        samples.field_mT, setting.astype(np.intp), frame,
    )  # fmt: skip


def _floor_poses(frames: FloorFrames, rows: int, cols: int, layout: ArrayGeometry | None) -> Pose:
    if layout is None:
        raise FitError("floor frames need the array's layout")
    m, n = frames.field_mT.shape[:2]
    if n != rows * cols:
        raise FitError(f"the floor frames have {n} whiskers, expected {rows} x {cols}")
    down = layout.R_base_whisker[:, 2, 2] < -0.999
    reach = layout.length - frames.tip_radius
    cosine = (frames.height[:, None] - frames.tip_radius) / reach
    free = cosine >= 1.0
    inclination = np.arccos(np.clip(cosine, -1.0, 1.0))
    # The tip trails behind its joint; its azimuth counts about the whisker's own axes.
    trailing = -np.stack([np.cos(frames.direction), np.sin(frames.direction), np.zeros(m)], axis=-1)
    local = np.einsum("nij,mi->mnj", layout.R_base_whisker, trailing)
    azimuth = np.arctan2(local[..., 1], local[..., 0])
    radius = np.maximum(reach * np.sin(inclination), 1e-6)
    # A rod that lies aside by an angle turns behind the drag like a tractrix, by exp(-way / radius).
    start = np.deg2rad(20.0) * np.exp(-frames.dragged[:, None] / np.maximum(radius, 0.02))
    sigma = np.where(free, np.pi, np.hypot(DRAG_SIGMA, start))
    height = np.where(free, FREE_SIGMA, np.minimum(HEIGHT_SIGMA / radius, np.deg2rad(5.0)))
    marks = np.round(np.column_stack([frames.height * 1e3, np.rad2deg(frames.direction)]), 1)
    setting = np.unique(marks, axis=0, return_inverse=True)[1].reshape(-1)
    used = frames.valid & layout.present & down & frames.field_mT.any(axis=-1)
    frame, whisker = np.nonzero(used)
    return Pose(
        whisker, inclination[used], height[used], azimuth[used], sigma[used], frames.field_mT[used],
        setting[frame].astype(np.intp), frame,
    )  # fmt: skip
