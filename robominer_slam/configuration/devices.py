"""From the configuration's `[[device]]` sections to what the drivers need."""

from __future__ import annotations

from drivers.settings import DeviceSettings
from robominer_slam.configuration.model import Configuration


def device_settings(configuration: Configuration) -> list[DeviceSettings]:
    """The drivers' settings of every device."""
    return [
        DeviceSettings(device.name, device.port, device.protocol, device.baud, device.ticks_per_turn)
        for device in configuration.device
    ]
