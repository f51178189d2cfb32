"""Spherical whisker frames as Cartesian ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drivers.measurement import FloatArray, HallFrame


def to_cartesian(spherical: FloatArray) -> FloatArray:
    """Bx, By, Bz from azimuth (deg), polar (deg, from the sensor's plane) and magnitude (mT), shape (..., 3) both ways.

    Where the magnitude is zero, because the firmware left it out, the result is a unit vector: the direction alone.
    """
    azimuth, polar = np.radians(spherical[..., 0]), np.radians(spherical[..., 1])
    magnitude = np.where(spherical[..., 2] == 0.0, 1.0, spherical[..., 2])
    in_plane = magnitude * np.cos(polar)
    return np.stack([in_plane * np.cos(azimuth), in_plane * np.sin(azimuth), magnitude * np.sin(polar)], axis=-1)


def cartesian_frame(frame: HallFrame) -> HallFrame:
    """The frame with representation `Cartesian` (mT) or, where no magnitude was sent, `Direction` (unit vectors)."""
    if frame.representation != "Spherical":
        return frame
    known = bool(frame.field_mT[..., 2].any())
    field_mT = np.where(frame.valid[..., None], to_cartesian(frame.field_mT), 0.0)
    return replace(frame, field_mT=field_mT, representation="Cartesian" if known else "Direction")
