"""From the configuration's `[[device]]` sections to what the drivers need."""

from __future__ import annotations

from typing import get_args

from drivers.settings import Carries, DeviceSettings
from robominer_slam.configuration.device_section import DeviceSection
from robominer_slam.configuration.model import Configuration

SENT_BY_PROTOCOL: dict[str, Carries] = {
    "rm3-plaintext": "whiskers",
    "rm3-compressed": "whiskers",
    "rm3-motor": "screws",
    "bno08x-rvc": "imu",
    "mip": "imu",
}


def device_settings(configuration: Configuration) -> list[DeviceSettings]:
    """The drivers' settings of every device."""
    return [
        DeviceSettings(
            name=device.name,
            port=device.port,
            protocol=device.protocol,
            baud=device.baud,
            ticks_per_turn=device.ticks_per_turn,
            rows=device.rows,
            cols=device.cols,
            representation=device.representation,
            sensor_period_us=device.sensor_period_us,
            screw=device.screw,
            use_orientation=device.use_orientation,
            acceleration=device.acceleration,
            carries=_carries(device),
        )
        for device in configuration.device
    ]


def _carries(device: DeviceSection) -> Carries | None:
    """What a device sends, as far as its section says: by its calibration, its protocol, or its name."""
    if device.calibration is not None:
        return "whiskers"
    if device.protocol in SENT_BY_PROTOCOL:
        return SENT_BY_PROTOCOL[device.protocol]
    return next((kind for kind in get_args(Carries) if kind == device.name), None)
