"""Streams of every protocol from the simulator's encoders, with what the decoders must make of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.decoders import make_decoder
from drivers.readings import Decoder, Reading
from sim_backend.bno08x_rvc_encoder import packet
from sim_backend.framed_encoder import FramedEncoder
from sim_backend.mip_encoder import MipDevice
from sim_backend.rm3_encoder import Rm3WhiskerEncoder, motor_message

UP = np.array([0.0, 0.0, 9.81])


@dataclass(frozen=True)
class Line:
    """One protocol: its packets, one bytes object each, and a fresh decoder."""

    packets: Callable[[int, int], list[bytes]]
    decoder: Callable[[], Decoder]


def fields(count: int, seed: int, sensors: int = 64) -> np.ndarray:
    """Fields as an array near rest gives, with a sensor's noise, shape (count, sensors, 3), mT."""
    rng = np.random.default_rng(seed)
    rest = rng.normal(0.0, 4.0, (sensors, 3)) + np.array([0.0, 0.0, 35.0])
    return rest + rng.normal(0.0, 0.5, (count, sensors, 3))


def whiskers(representation: str, compressed: bool, rows: int = 8, cols: int = 8) -> Line:
    def packets(count: int, seed: int) -> list[bytes]:
        encoder = Rm3WhiskerEncoder(rows, cols, representation)
        encode = encoder.compressed if compressed else encoder.plaintext
        valid = np.ones(rows * cols, bool)
        return [encode(valid, field) for field in fields(count, seed, rows * cols)]

    name = "rm3-compressed" if compressed else "rm3-plaintext"
    return Line(packets, lambda: make_decoder(name, rows, cols, representation))


def motors(electrical: bool) -> Line:
    def packets(count: int, seed: int) -> list[bytes]:
        rng = np.random.default_rng(seed)
        return [
            motor_message(int(rng.integers(4)), rng.normal(0, 40), (rng.normal(900, 50), 23.5) if electrical else None)
            for _ in range(count)
        ]

    return Line(packets, lambda: make_decoder("rm3-motor"))


def rvc_packets(count: int, seed: int) -> list[bytes]:
    rng = np.random.default_rng(seed)
    return [packet(k, rng.uniform([-180, -90, -180], [180, 90, 180]), rng.normal(0, 1, 3) + UP) for k in range(count)]


def mip_packets(count: int, seed: int) -> list[bytes]:
    rng, device = np.random.default_rng(seed), MipDevice("streaming")
    return [device.sample(10_000 * k, rng.normal(0, 0.1, 3), UP + rng.normal(0, 0.1, 3)) for k in range(count)]


def framed_packets(count: int, seed: int) -> list[bytes]:
    encoder, valid = FramedEncoder(), np.ones(64, bool)
    return [encoder.hall(40_000 * k, 8, 8, 600, valid, field) for k, field in enumerate(fields(count, seed))]


LINES = {
    "framed": Line(framed_packets, lambda: make_decoder("framed")),
    "rm3-plaintext cartesian": whiskers("cartesian", False),
    "rm3-plaintext spherical-magnitude": whiskers("spherical-magnitude", False),
    "rm3-compressed cartesian": whiskers("cartesian", True),
    "rm3-compressed spherical": whiskers("spherical", True),
    "rm3-compressed spherical-magnitude": whiskers("spherical-magnitude", True),
    "rm3-compressed 3x5": whiskers("cartesian", True, 3, 5),
    "rm3-motor": motors(True),
    "rm3-motor short": motors(False),
    "bno08x-rvc": Line(rvc_packets, lambda: make_decoder("bno08x-rvc")),
    "mip": Line(mip_packets, lambda: make_decoder("mip")),
}


def content(reading: Reading) -> tuple[object, ...]:
    """All values of a reading in a form that compares."""
    return tuple(value.tobytes() if isinstance(value, np.ndarray) else value for value in reading)


def decoded(decoder: Decoder, pieces: list[bytes]) -> list[tuple[object, ...]]:
    """Contents of everything that comes out."""
    return [content(reading) for piece in pieces for reading in decoder.feed(piece)]


def damaged(stream: bytes, share: float, rng: np.random.Generator) -> bytes:
    """The stream with this share of its bytes changed to others."""
    values = np.frombuffer(stream, np.uint8).copy()
    hit = rng.random(len(values)) < share
    values[hit] ^= rng.integers(1, 256, int(hit.sum()), dtype=np.uint8)
    return values.tobytes()


def mutate(stream: bytes, rng: np.random.Generator) -> bytes:
    """The stream with bytes changed, pieces lost, doubled and inserted."""
    data = bytearray(damaged(stream, 0.001, rng))
    for _ in range(max(1, len(data) // 1500)):
        at, size = int(rng.integers(len(data))), int(rng.integers(1, 60))
        match int(rng.integers(3)):
            case 0:
                del data[at : at + size]
            case 1:
                data[at:at] = data[at : at + size]
            case _:
                data[at:at] = rng.bytes(size)
    return bytes(data)
