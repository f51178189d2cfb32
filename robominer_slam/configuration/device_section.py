"""`[[device]]`: one port and what is on it, with the keys that its protocol knows."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from robominer_slam.configuration.parameter import KeyChunk, Section, parameter

#: Keys that only some protocols know.
WHISKERS = ("framed", "rm3-plaintext", "rm3-compressed")
RM3_WHISKERS = ("rm3-plaintext", "rm3-compressed")
IMUS = ("framed", "bno08x-rvc", "mip")
PROTOCOLS_OF_KEY: dict[str, tuple[str, ...]] = {
    "calibration": WHISKERS,
    "rows": WHISKERS,
    "cols": WHISKERS,
    "representation": RM3_WHISKERS,
    "sensor_period_us": RM3_WHISKERS,
    # A module of rm3-motor reports speeds and needs no ticks, but may share the other screws' keys.
    "ticks_per_turn": ("framed",),
    "screw": ("rm3-motor",),
    "mount_rpy_deg": IMUS,
    "acceleration": IMUS,
    "use_orientation": IMUS,
}
#: A 3DM-CV7's axes, x forward, y right, z down, in base_link's: it lies the right way up.
MIP_MOUNT_RPY_DEG = (180.0, 0.0, 0.0)


class DeviceSection(Section):
    """One port and what is on it."""

    name: KeyChunk = Field(description="the device's name in status, logs and keys", json_schema_extra={"unit": ""})
    port: str = Field(description="path, usb:VID:PID[:SERIAL] or auto", json_schema_extra={"unit": ""})
    protocol: Literal["framed", "rm3-plaintext", "rm3-compressed", "rm3-motor", "bno08x-rvc", "mip"] = parameter(
        "framed", "", "what the device speaks"
    )
    baud: int = parameter(115200, "bit/s", "the Arduino default; USB CDC devices ignore it", low=1200, high=12_000_000)
    calibration: str | None = parameter(None, "", "calibration file of the whiskers on this device")
    rows: int = parameter(8, "1", "rows of the array: RM3's multiplexers; framed says them itself", low=1, high=255)
    cols: int = parameter(8, "1", "sensors behind each of RM3's multiplexers", low=1, high=255)
    representation: Literal["cartesian", "spherical", "spherical-magnitude"] = parameter(
        "spherical", "", "RM3's firmware prints angles by default; with spherical, the magnitude is found out"
    )
    sensor_period_us: float | None = parameter(
        None, "us", "from one sensor's reading to the next; not set: the frame's period is shared among the sensors",
        low=0.0, high=1e6,
    )  # fmt: skip
    ticks_per_turn: int = parameter(4096, "1", "encoder ticks per turn of a screw", low=1, high=10_000_000)
    screw: Literal["front_right", "rear_right", "rear_left", "front_left"] | None = parameter(
        None, "", "whose board must be on this port; another's speeds are refused"
    )
    mount_rpy_deg: tuple[float, float, float] = parameter(
        (0.0, 0.0, 0.0), "deg", "rotation of the IMU in base_link: roll, pitch, yaw, applied yaw first; mip: 180, 0, 0"
    )
    acceleration: Literal["specific_force", "gravity_free"] = parameter(
        "specific_force", "", "gravity_free where the IMU's driver has removed gravity already"
    )
    use_orientation: bool = parameter(
        True, "", "take the turn rate of an IMU without gyro from the increments of its attitude"
    )

    def concerns(self, key: str) -> bool:
        """Whether this device's protocol knows a key."""
        return self.protocol in PROTOCOLS_OF_KEY.get(key, (self.protocol,))

    @model_validator(mode="before")
    @classmethod
    def _mip_points_down(cls, data: object) -> object:
        if isinstance(data, dict) and data.get("protocol") == "mip" and "mount_rpy_deg" not in data:
            return {**data, "mount_rpy_deg": MIP_MOUNT_RPY_DEG}
        return data

    @model_validator(mode="after")
    def _keys_fit_the_protocol(self) -> DeviceSection:
        wrong = sorted(key for key in self.model_fields_set if not self.concerns(key))
        if wrong:
            fitting = ", ".join(PROTOCOLS_OF_KEY[wrong[0]])
            raise ValueError(
                f"expected no key {', '.join(wrong)} with protocol {self.protocol!r}: {wrong[0]} is for {fitting}"
            )
        return self
