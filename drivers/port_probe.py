"""Is this the device that is wanted? Found out by listening: a port may belong to a motor, which nobody may talk to.

A port that is named by its path is taken at its word. Where a name may mean several ports (`auto`, a pattern, equal
USB adapters), each is listened to until what comes is what the device should send.
"""

from __future__ import annotations

from collections import Counter
from typing import Literal, TypeAlias

from drivers.readings import (
    EncoderReading,
    HallReading,
    ImuReading,
    MotorReading,
    OdometryReading,
    Reading,
    ScrewReading,
)
from drivers.settings import Carries, DeviceSettings

Verdict: TypeAlias = Literal["listening", "right", "wrong", "silent"]

#: The slowest device (`rm3-motor`) sends every 0.2 s.
LISTEN_NS = 700_000_000
#: A device that may be idle until it is told to start (`mip`) is told so after this silence.
SILENCE_BEFORE_SPEAKING_NS = 200_000_000
_KINDS: dict[type, Carries] = {
    HallReading: "whiskers",
    ImuReading: "imu",
    EncoderReading: "screws",
    MotorReading: "screws",
    ScrewReading: "screws",
    OdometryReading: "odometry",
}


def kind_of(reading: Reading) -> Carries | None:
    """What kind of device sends this; None for what says nothing about that."""
    return _KINDS.get(type(reading))


def verdict(
    settings: DeviceSettings,
    heard: Counter[str],
    known: frozenset[str],
    *,
    other_screw: bool,
    elapsed_ns: int,
    any_bytes: bool,
) -> Verdict:
    """What is known of a port so far.

    Args:
        settings: of the device that is wanted.
        heard: readings of the port by kind.
        known: kinds that the device sent when it was last here; empty if it never was.
        other_screw: whether it is the board of another screw.
        elapsed_ns: since it was opened.
        any_bytes: whether anything came.
    """
    if other_screw:
        return "wrong"
    # A frame with a CRC is no accident; a checksum of one byte can be.
    needed = 1 if settings.protocol == "framed" else 2
    wanted = {settings.carries} if settings.carries is not None else known or set(heard)
    if any(heard[kind] >= needed for kind in wanted):
        return "right"
    if elapsed_ns < LISTEN_NS:
        return "listening"
    return "wrong" if any_bytes else "silent"


def may_speak(settings: DeviceSettings, heard: Counter[str], *, elapsed_ns: int, any_bytes: bool) -> bool:
    """Whether a port that is still listened to may be written to."""
    if heard:
        return True
    return settings.protocol == "mip" and not any_bytes and elapsed_ns > SILENCE_BEFORE_SPEAKING_NS
