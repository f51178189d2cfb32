"""`robominer_msgs/msg/WhiskerArray` packed and unpacked in one go, and what it means as a HallFrame.

64 whiskers are 128 nested objects for a general decoder, 25 times a second. In CDR a `Whisker` always takes 24
bytes at a 4-byte boundary, so the whole sequence is one numpy record array.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from drivers import cdr
from drivers.counters import Counters
from drivers.measurement import HallFrame
from drivers.ros_messages import (
    CDR_LITTLE_ENDIAN,
    NANOSECONDS_PER_SECOND,
    MessageError,
    deserialize,
    time_to_ns,
)

TYPENAME = "robominer_msgs/msg/WhiskerArray"
REPRESENTATIONS = ("Cartesian", "Spherical")
#: Offset of odd rows against even ones, in columns, as the RM3 firmware fills it in; nothing here reads it.
ODD_ROW_OFFSET = -0.5

#: One `Whisker` as CDR lays it out; the bytes between the fields are padding.
WHISKER = np.dtype(
    {
        "names": ["row_num", "col_num", "offset_y", "has_error", "x", "y", "z"],
        "formats": ["u1", "u1", "<f4", "u1", "<f4", "<f4", "<f4"],
        "offsets": [0, 1, 4, 8, 12, 16, 20],
        "itemsize": 24,
    }
)


@dataclass(frozen=True, slots=True)
class WhiskerArray:
    """The message's content; `whiskers` has dtype `WHISKER`, one record a whisker, in the message's order."""

    stamp_ns: int
    frame_id: str
    num_mux: int
    num_sensors: int
    representation: str
    whiskers: NDArray[np.void]


def encode(message: WhiskerArray) -> bytes:
    """The message as little-endian CDR, byte for byte as a general serialiser writes it."""
    body = cdr.stamp(message.stamp_ns)
    body += cdr.string(message.frame_id, len(body))
    body += bytes((message.num_mux, message.num_sensors))
    body += cdr.string(message.representation, len(body))
    body += cdr.padding(len(body), 4) + cdr.UINT32.pack(len(message.whiskers))
    # A fresh zeroed array, so that padding never carries what was in memory before.
    records = np.zeros(len(message.whiskers), dtype=WHISKER)
    for name in WHISKER.names or ():
        records[name] = message.whiskers[name]
    return CDR_LITTLE_ENDIAN + body + records.tobytes()


def decode(data: bytes) -> WhiskerArray:
    """The message from CDR of either byte order.

    Raises:
        MessageError: the bytes are not one whole WhiskerArray.
    """
    if data[:2] != CDR_LITTLE_ENDIAN[:2]:
        return _decode_general(data)
    body = memoryview(data)[4:]
    try:
        sec, nanosec = cdr.STAMP.unpack_from(body)
        frame_id, at = _read_string(body, cdr.STAMP.size)
        num_mux, num_sensors = body[at], body[at + 1]
        representation, at = _read_string(body, at + 2)
        at = cdr.align(at, 4)
        (count,) = cdr.UINT32.unpack_from(body, at)
    except (struct.error, IndexError, UnicodeDecodeError) as error:
        raise MessageError(f"not a message of type {TYPENAME}: {error}") from error
    at += cdr.UINT32.size
    surplus = len(body) - at - count * WHISKER.itemsize
    if not 0 <= surplus <= 3:
        raise MessageError(f"not a message of type {TYPENAME}: {count} whiskers do not fit {len(data)} bytes")
    whiskers = np.frombuffer(body, dtype=WHISKER, count=count, offset=at) if count else np.zeros(0, WHISKER)
    stamp_ns = sec * NANOSECONDS_PER_SECOND + nanosec
    return WhiskerArray(stamp_ns, frame_id, num_mux, num_sensors, representation, whiskers)


def _read_string(body: memoryview, at: int) -> tuple[str, int]:
    at = cdr.align(at, 4)
    (length,) = cdr.UINT32.unpack_from(body, at)
    end = at + cdr.UINT32.size + length
    if length == 0 or end > len(body):
        raise IndexError(f"a string of {length} bytes at {at}")
    return bytes(body[at + cdr.UINT32.size : end - 1]).decode(), end


def _decode_general(data: bytes) -> WhiskerArray:
    message = deserialize(data, TYPENAME)
    whiskers = np.zeros(len(message.whiskers), dtype=WHISKER)
    for record, whisker in zip(whiskers, message.whiskers, strict=True):
        position = whisker.pos
        record["row_num"], record["col_num"] = position.row_num, position.col_num
        record["offset_y"] = position.offset_y
        record["has_error"] = whisker.has_error
        record["x"], record["y"], record["z"] = whisker.x, whisker.y, whisker.z
    return WhiskerArray(
        time_to_ns(message.header.stamp),
        message.header.frame_id,
        message.num_mux,
        message.num_sensors,
        message.representation,
        whiskers,
    )


def encode_frame(frame: HallFrame, frame_id: str = "") -> bytes:
    """A HallFrame as CDR; `sensor_period_ns` has no place in the message.

    Raises:
        MessageError: more rows or columns than the message can name.
    """
    rows, cols = frame.valid.shape
    if rows > 255 or cols > 255:
        raise MessageError(f"an array of {rows} x {cols} whiskers does not fit a WhiskerArray (255 x 255)")
    records = np.zeros(rows * cols, dtype=WHISKER)
    row, col = np.divmod(np.arange(rows * cols), cols)
    records["row_num"], records["col_num"] = row, col
    records["offset_y"] = np.where(row % 2 == 1, ODD_ROW_OFFSET, 0.0)
    records["has_error"] = ~frame.valid.ravel()
    field_mT = np.where(frame.valid[..., None], frame.field_mT, 0.0).reshape(-1, 3)
    records["x"], records["y"], records["z"] = field_mT.T
    return encode(WhiskerArray(frame.stamp_ns, frame_id, rows, cols, frame.representation, records))


def decode_frame(data: bytes, counters: Counters, sensor_period_ns: int = 0) -> HallFrame:
    """The HallFrame in a message; whiskers that it leaves out are invalid.

    Args:
        data: CDR bytes.
        counters: `not_finite` counts whiskers whose field is not finite; they become invalid.
        sensor_period_ns: goes into the frame.

    Raises:
        MessageError: the bytes are not one whole WhiskerArray, or its content contradicts itself.
    """
    message = decode(data)
    if message.representation not in REPRESENTATIONS:
        raise MessageError(f"representation {message.representation!r}, expected one of {REPRESENTATIONS}")
    rows, cols = message.num_mux, message.num_sensors
    # The fields as columns of one array: a record array's own take a numpy call each.
    records = message.whiskers.view(np.uint8).reshape(-1, WHISKER.itemsize)
    place = _places(records[:, :2].tobytes(), rows, cols)
    values = records.view("<f4")[:, 3:].astype(np.float64)
    usable = records[:, 8] == 0
    finite = np.isfinite(values)
    if not finite.all():
        good = finite.all(axis=1)
        if not_finite := int(np.count_nonzero(usable & ~good)):
            counters["not_finite"] += not_finite
        usable &= good
    field_mT = np.zeros((rows, cols, 3))
    valid = np.zeros((rows, cols), dtype=np.bool_)
    if not usable.all():
        place, values = place[usable], values[usable]
    valid.reshape(-1)[place] = True
    field_mT.reshape(-1, 3)[place] = values
    return HallFrame(message.stamp_ns, field_mT, valid, sensor_period_ns, message.representation)


@lru_cache(maxsize=8)
def _places(positions: bytes, rows: int, cols: int) -> NDArray[np.intp]:
    """Where whiskers go in an array that is row-major, from their rows and columns as they stand in the message.

    Kept, because an array sends the same ones in every frame.

    Raises:
        MessageError: one is outside the array.
    """
    row, col = np.frombuffer(positions, dtype=np.uint8).reshape(-1, 2).T.astype(np.intp)
    if rows * cols == 0 or (row >= rows).any() or (col >= cols).any():
        raise MessageError(f"a whisker outside the array of {rows} x {cols}")
    return np.asarray(row * cols + col)
