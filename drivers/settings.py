"""What a device needs to know about itself; the configuration fills it in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from drivers.rm3_values import Representation

Protocol: TypeAlias = Literal["framed", "rm3-plaintext", "rm3-compressed", "rm3-motor", "bno08x-rvc", "mip"]
Carries: TypeAlias = Literal["whiskers", "imu", "screws", "odometry"]
Screw: TypeAlias = Literal["front_right", "rear_right", "rear_left", "front_left"]


@dataclass(frozen=True, slots=True)
class DeviceSettings:
    """One port.

    Attributes:
        name: the device's name in status, logs and keys.
        port: a path, a pattern of paths, `usb:VID:PID[:SERIAL]` (hexadecimal ids) or `auto`.
        protocol: the protocol spoken on it.
        baud: bits per second (USB CDC devices ignore it).
        ticks_per_turn: encoder ticks per turn of a screw.
        rows, cols: of the whisker array, where frames do not say it themselves.
        representation: of RM3's whisker frames.
        sensor_period_us: from one sensor's reading to the next, where frames do not say it; None: found out.
        screw: whose board must be on this port (rm3-motor); None: any.
        use_orientation: whether an IMU's own attitude is passed on.
        carries: what it must send, where its port is found by listening; None: what the protocol says.
        acceleration: whether the IMU's acceleration has gravity in it (`specific_force`) or not (`gravity_free`).
    """

    name: str
    port: str
    protocol: Protocol = "framed"
    baud: int = 115200
    ticks_per_turn: int = 4096
    rows: int = 8
    cols: int = 8
    representation: Representation = "spherical"
    sensor_period_us: float | None = None
    screw: Screw | None = None
    use_orientation: bool = True
    acceleration: Literal["specific_force", "gravity_free"] = "specific_force"
    carries: Carries | None = None
