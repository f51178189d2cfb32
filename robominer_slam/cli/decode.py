"""`robominer-slam decode`: bytes as they came from a port, as the drivers understand them."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import click
import numpy as np

from drivers.decoders import PROTOCOLS, make_decoder
from drivers.measurement import SCREW_NAMES
from drivers.readings import (
    EncoderReading,
    HallReading,
    ImuReading,
    MotorReading,
    OdometryReading,
    Reading,
    ScrewReading,
    count_not_finite,
)
from drivers.rm3_values import Representation

CHUNK_BYTES = 65536
REPRESENTATIONS: tuple[Representation, ...] = ("cartesian", "spherical", "spherical-magnitude")


class DecodeUsageError(click.ClickException):
    """The user's mistake, in one line."""

    exit_code = 2


@click.command(epilog="Example: robominer-slam decode --protocol rm3-compressed --representation cartesian port.bin")
@click.option("--protocol", required=True, metavar="P", help=f"One of {', '.join(PROTOCOLS)}.")
@click.option("--rows", default=8, show_default=True, type=click.IntRange(1, 255), help="Rows of RM3's array.")
@click.option("--cols", default=8, show_default=True, type=click.IntRange(1, 255), help="Sensors in a row.")
@click.option("--representation", default="spherical", show_default=True, help=f"One of {', '.join(REPRESENTATIONS)}.")
@click.argument("file")
def decode(protocol: str, rows: int, cols: int, representation: str, file: str) -> None:
    """Decode a port's bytes from FILE (- for stdin): a JSON line for each measurement, then the counters."""
    spoken = next((known for known in PROTOCOLS if known == protocol), None)
    if spoken is None:
        raise DecodeUsageError(f"protocol {protocol!r}: expected one of {', '.join(PROTOCOLS)}")
    meant = next((known for known in REPRESENTATIONS if known == representation), None)
    if meant is None:
        raise DecodeUsageError(f"representation {representation!r}: expected one of {', '.join(REPRESENTATIONS)}")
    decoder = make_decoder(spoken, rows, cols, meant)
    try:
        with _opened(file) as stream:
            for chunk in _chunks(stream):
                for reading in decoder.feed(chunk):
                    if not_finite := count_not_finite(reading):
                        decoder.counters["not_finite"] += not_finite
                    described = describe(reading)
                    if described is not None:
                        click.echo(json.dumps(described, allow_nan=False))
    except OSError as error:
        raise DecodeUsageError(f"{file}: cannot be read: {error.strerror or error}") from error
    click.echo(json.dumps({"counters": {name: count for name, count in sorted(decoder.counters.items()) if count}}))


def _opened(file: str) -> BinaryIO:
    return sys.stdin.buffer if file == "-" else Path(file).open("rb")


def _chunks(stream: BinaryIO) -> Iterator[bytes]:
    while chunk := stream.read(CHUNK_BYTES):
        yield chunk


def describe(reading: Reading) -> dict[str, Any] | None:
    """What a reading says, for JSON, in SI units; None for what is no measurement (greetings, answers)."""
    fields: dict[str, Any]
    match reading:
        case HallReading():
            kind, fields = "hall", _hall(reading)
        case ImuReading():
            kind, fields = "imu", _imu(reading)
        case EncoderReading(ticks=ticks):
            kind, fields = "encoders", {"ticks": list(ticks)}
        case MotorReading():
            current = reading.current_mA * 1e-3
            kind, fields = "motors", {"speed": reading.speed, "current": current, "voltage": reading.voltage_V}
        case ScrewReading():
            current_A = None if reading.current_mA is None else reading.current_mA * 1e-3
            values = {"speed": reading.speed, "current": current_A, "voltage": reading.voltage_V}
            kind, fields = "motor", {"motor_id": reading.screw, "screw": SCREW_NAMES[reading.screw], **values}
        case OdometryReading(velocity=velocity):
            kind, fields = "odometry", {"velocity": velocity}
        case _:
            return None
    head = {"type": kind, "t_us": reading.device_time_us, "sequence": reading.sequence}
    return head | {name: _plain(value) for name, value in fields.items()}


def _hall(reading: HallReading) -> dict[str, Any]:
    """Field in mT, or angles (rad) and magnitude (mT; None where none was sent); None for invalid sensors."""
    values = np.where(reading.valid[..., None], reading.field_mT, np.nan)
    fields: dict[str, Any] = {"representation": reading.representation.lower()}
    if reading.representation == "Cartesian":
        fields["field_mT"] = values
    else:
        fields["azimuth"], fields["polar"] = np.radians(values[..., 0]), np.radians(values[..., 1])
        fields["magnitude_mT"] = values[..., 2] if reading.field_mT[..., 2].any() else None
    return fields | {"valid": reading.valid, "sensor_period_us": reading.sensor_period_us or None}


def _imu(reading: ImuReading) -> dict[str, Any]:
    fields: dict[str, Any] = {"gyro": reading.gyro, "acceleration": reading.acceleration}
    if reading.orientation_xyzw is not None:
        x, y, z, w = (float(value) for value in reading.orientation_xyzw)
        fields["orientation_xyzw"] = reading.orientation_xyzw
        fields["yaw"] = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        fields["pitch"] = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
        fields["roll"] = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return fields


def _plain(value: object) -> object:
    """Numbers rounded to what the sensors can tell, lists for arrays, None for what is not finite."""
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return round(value, 9) if math.isfinite(value) else None
    return value
