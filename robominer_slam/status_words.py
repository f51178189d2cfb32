"""The daemon's state in one line of words, for `systemctl status`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drivers.device import DeviceStatus
from robominer_slam.frame_result import FrameResult


class StatusWords(NamedTuple):
    """What is said.

    Attributes:
        state: what it does: worth a line as soon as it changes.
        devices: what each device does: likewise.
        figures: what changes all the time.
    """

    state: str
    devices: str
    figures: str = ""

    def __str__(self) -> str:
        first = ", ".join(part for part in (self.state, self.figures) if part)
        return "; ".join(part for part in (first, self.devices) if part)


def slam_words(
    frame: FrameResult | None, rate_hz: float, keyframes: int, devices: Sequence[DeviceStatus]
) -> StatusWords:
    """Such as `tracking, 25 Hz, 134 keyframes, sure within 2 cm; whiskers streaming, imu silent`.

    Args:
        frame: the last one, None before the first.
        rate_hz: of frames, now.
        keyframes: in the map.
        devices: as the source tells them.
    """
    if frame is None:
        return StatusWords("waiting for the first whisker frame", device_words(devices))
    figures = [f"{rate_hz:.0f} Hz", f"{keyframes} keyframes"]
    if frame.state not in ("lost", "relocalizing"):
        # Two standard deviations: nine times out of ten and more, the robot is as near as that.
        figures.append(f"sure within {_length(2.0 * float(np.sqrt(np.trace(frame.covariance[:2, :2]))))}")
    state = frame.state.replace("_", " ") if rate_hz > 0.0 else f"{frame.state.replace('_', ' ')}, but no frames"
    return StatusWords(state, device_words(devices), ", ".join(figures))


def device_words(devices: Sequence[DeviceStatus]) -> str:
    """Every device with what it does."""
    return ", ".join(f"{device.name} {device.state}" for device in devices) or "no device heard"


def _length(metres: float) -> str:
    return f"{max(1, math.ceil(metres * 100))} cm" if metres < 1.0 else f"{metres:.1f} m"
