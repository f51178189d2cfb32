"""The telemetry message: what a remote operator needs four times a second, in at most 200 bytes.

Little-endian, without padding; version 1:

| offset | type | meaning |
|---|---|---|
| 0 | u8 | version, 1 |
| 1 | u8 | localization state: 0 lost, 1 relocalizing, 2 dead_reckoning, 3 tracking |
| 2 | u16 | health bits, see `Health` |
| 4 | u16 | sequence, +1 each message, wraps |
| 6 | i64 | stamp, UNIX ns |
| 14 | 7 x f32 | pose of base_link in map: x y z (m), qx qy qz qw |
| 42 | 6 x u16 | sigmas: x y z in mm, roll pitch yaw in 0.1 mrad; 65535: that or more |
| 54 | 3 x i16 | body velocity: vx vy in mm/s, wz in mrad/s, held at the ends of the range |
| 60 | u32 | version of the map |
| 64 | u32 | keyframes in the map |
| 68 | u16 | loop closures |
| 70 | u16 | whiskers in contact |
| 72 | u8, u8 | rows and columns of the array; 0, 0 if its whiskers do not fit the message |
| 74 | rows x columns bytes | whiskers, row-major |

A whisker's byte: the high four bits are the inclination, 0 free, 1 to 14 in fourteenths of 90 degrees (value k
stands for the middle of its step), 15 no valid reading; the low four bits are the azimuth in sixteenths of a turn
from -180 degrees. The middle of a step errs by at most 3.2 degrees in inclination, 11.3 degrees in azimuth.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

VERSION = 1
MAX_BYTES = 200
STATES = ("lost", "relocalizing", "dead_reckoning", "tracking")

_HEAD = struct.Struct("<BBHHq7f6H3hIIHHBB")
MAX_WHISKERS = MAX_BYTES - _HEAD.size

_INCLINATION_STEPS = 14
_INCLINATION_STEP = np.pi / 2 / _INCLINATION_STEPS
_AZIMUTH_STEPS = 16
_AZIMUTH_STEP = 2 * np.pi / _AZIMUTH_STEPS
_FREE, _INVALID = 0, 15
#: Units of the sigmas, per m and per rad, and of the velocity.
_SIGMA_UNITS = (1e3, 1e3, 1e3, 1e4, 1e4, 1e4)
_VELOCITY_UNITS = 1e3


class TelemetryError(ValueError):
    """Bytes that are no telemetry message, or a state that cannot be put into one."""


class Health(IntFlag):
    """What is wrong; 0: nothing."""

    FINE = 0
    WHISKERS_SILENT = 1
    IMU_SILENT = 2
    SCREWS_SILENT = 4
    WHISKERS_FAULTY = 8
    CLOCK_NOT_SYNCHRONISED = 16
    BACKEND_LATE = 32
    STORE_FAILING = 64
    PAUSED = 128
    MEASUREMENTS_DROPPED = 256


@dataclass(frozen=True, slots=True)
class Telemetry:
    """The robot at a time.

    Attributes:
        sequence: +1 each message, modulo 65536.
        stamp_ns: UNIX time.
        state: one of `STATES`.
        pose: T_map_base as x y z (m), qx qy qz qw; shape (7,).
        sigmas: standard deviations of x y z (m), roll pitch yaw (rad); shape (6,).
        velocity: of base_link in base_link: vx vy (m/s), wz (rad/s); shape (3,).
        contacts: whiskers that touch.
        inclination, azimuth: of all whiskers, shape (rows, cols), rad; 0 inclination: free, NaN: no valid
            reading; shape (0, 0) where they were left out.
        health: what is wrong.
        map_version, keyframes, closures: of the map.
    """

    sequence: int
    stamp_ns: int
    state: str
    pose: FloatArray
    sigmas: FloatArray
    velocity: FloatArray
    contacts: int
    inclination: FloatArray
    azimuth: FloatArray
    health: Health = Health.FINE
    map_version: int = 0
    keyframes: int = 0
    closures: int = 0


def encode(telemetry: Telemetry) -> bytes:
    """The message; an array of more than `MAX_WHISKERS` whiskers is left out.

    Raises:
        TelemetryError: an unknown state, or a number that is not finite where one is needed.
    """
    if telemetry.state not in STATES:
        raise TelemetryError(f"localization state {telemetry.state!r}, expected one of {STATES}")
    pose, velocity = telemetry.pose.tolist(), telemetry.velocity.tolist()
    if not all(map(math.isfinite, (*pose, *velocity))):
        raise TelemetryError("a pose or velocity that is not finite")
    rows, cols = telemetry.inclination.shape
    if rows * cols > MAX_WHISKERS or rows > 255 or cols > 255:
        rows = cols = 0
    sigmas = zip(telemetry.sigmas.tolist(), _SIGMA_UNITS, strict=True)
    head = _HEAD.pack(
        VERSION,
        STATES.index(telemetry.state),
        int(telemetry.health),
        telemetry.sequence & 0xFFFF,
        telemetry.stamp_ns,
        *pose,
        *(_sigma_steps(sigma * unit) for sigma, unit in sigmas),
        *(min(max(round(value * _VELOCITY_UNITS), -32768), 32767) for value in velocity),
        telemetry.map_version & 0xFFFFFFFF,
        min(telemetry.keyframes, 0xFFFFFFFF),
        min(telemetry.closures, 0xFFFF),
        min(telemetry.contacts, 0xFFFF),
        rows,
        cols,
    )
    return head + (_pack_whiskers(telemetry.inclination, telemetry.azimuth) if rows else b"")


def _sigma_steps(value: float) -> int:
    # Not finite or beyond the range both mean: as good as unknown.
    return min(max(round(value), 0), 65535) if math.isfinite(value) else 65535


def decode(data: bytes) -> Telemetry:
    """The state in a message.

    Raises:
        TelemetryError: not a telemetry message, or of another version.
    """
    if not data or data[0] != VERSION:
        raise TelemetryError(f"telemetry of version {data[0] if data else 'none'}, expected {VERSION}")
    if len(data) < _HEAD.size:
        raise TelemetryError(f"a telemetry message of {len(data)} bytes, expected {_HEAD.size} or more")
    _, state, health, sequence, stamp_ns, *numbers = _HEAD.unpack_from(data)
    rows, cols = numbers[20], numbers[21]
    if state >= len(STATES) or len(data) != _HEAD.size + rows * cols:
        raise TelemetryError("a telemetry message that contradicts itself")
    inclination, azimuth = _unpack_whiskers(data[_HEAD.size :])
    pose = np.array(numbers[:7])
    if not np.isfinite(pose).all():
        raise TelemetryError("a pose that is not finite")
    return Telemetry(
        sequence=sequence,
        stamp_ns=stamp_ns,
        state=STATES[state],
        pose=pose,
        sigmas=np.array(numbers[7:13]) / np.array(_SIGMA_UNITS),
        velocity=np.array(numbers[13:16]) / _VELOCITY_UNITS,
        contacts=numbers[19],
        inclination=inclination.reshape(rows, cols),
        azimuth=azimuth.reshape(rows, cols),
        health=Health(health),
        map_version=numbers[16],
        keyframes=numbers[17],
        closures=numbers[18],
    )


def _pack_whiskers(inclination: FloatArray, azimuth: FloatArray) -> bytes:
    phi, angle = inclination.ravel(), azimuth.ravel()
    valid = np.isfinite(phi + angle)
    # In floats to the end: numpy takes its time over each change of type.
    packed = np.where(valid, float(_FREE << 4), float(_INVALID << 4))
    (bent,) = (valid & (phi > 0.0)).nonzero()
    step = np.floor(np.minimum(phi[bent] / _INCLINATION_STEP, _INCLINATION_STEPS - 1.0)) + 1.0
    sector = np.rint((angle[bent] + np.pi) / _AZIMUTH_STEP)
    packed[bent] = 16.0 * step + sector % _AZIMUTH_STEPS
    return packed.astype(np.uint8).tobytes()


def _unpack_whiskers(data: bytes) -> tuple[FloatArray, FloatArray]:
    packed = np.frombuffer(data, dtype=np.uint8)
    step, sector = (packed >> 4).astype(np.float64), (packed & 15).astype(np.float64)
    inclination = (step - 0.5) * _INCLINATION_STEP
    # Azimuths lie in (-pi, pi].
    azimuth = np.where(sector == 0, np.pi, sector * _AZIMUTH_STEP - np.pi)
    free, invalid = step == _FREE, step == _INVALID
    inclination = np.where(invalid, np.nan, np.where(free, 0.0, inclination))
    azimuth = np.where(invalid, np.nan, np.where(free, 0.0, azimuth))
    return inclination, azimuth
