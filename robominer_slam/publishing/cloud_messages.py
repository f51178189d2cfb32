"""Point clouds as sensor_msgs/PointCloud2 in CDR: the whiskers' contacts and the map.

Everything in a PointCloud2 is aligned to four bytes at most, so that the description of a point's fields is a
constant, and only the header, two counts and the data differ from message to message.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from drivers import cdr

FloatArray = NDArray[np.float64]

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"

#: sensor_msgs/PointField: numbers of the data types in use.
_UINT16, _FLOAT32 = 4, 7
_DATATYPES = {"<f4": _FLOAT32, "<u2": _UINT16}

#: A contact: position in base_link (m), the whisker's number (row-major), its angles (rad); packed, 22 bytes.
CONTACT_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("index", "<u2"), ("inclination", "<f4"), ("azimuth", "<f4")]
)
MAP_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])

#: More points than this would make a message of over 1 MiB, which receivers refuse.
MAX_MAP_POINTS = 85_000

_STEPS = struct.Struct("<III")


def _field_descriptions(point: np.dtype[np.void]) -> bytes:
    """`PointField[] fields` and `bool is_bigendian`, for a start aligned to 4."""
    fields = [(name, *field[:2]) for name, field in (point.fields or {}).items()]
    packed = cdr.UINT32.pack(len(fields))
    for name, dtype, offset in fields:
        packed += cdr.string(name, len(packed))
        packed += cdr.padding(len(packed), 4) + cdr.UINT32.pack(offset)
        packed += bytes((_DATATYPES[dtype.str],))
        packed += cdr.padding(len(packed), 4) + cdr.UINT32.pack(1)
    packed += b"\0"
    return packed + cdr.padding(len(packed), 4)


_DESCRIPTIONS = {point: _field_descriptions(point) for point in (CONTACT_POINT, MAP_POINT)}


def _cloud(stamp_ns: int, frame: str, points: NDArray[np.void]) -> bytes:
    head = cdr.stamp(stamp_ns) + cdr.string(frame, 8)
    head += cdr.padding(len(head), 4) + cdr.UINT32.pack(1) + cdr.UINT32.pack(len(points))
    data = points.tobytes()
    steps = _STEPS.pack(points.dtype.itemsize, len(data), len(data))
    # Height 1, little-endian, dense.
    return cdr.CDR_LITTLE_ENDIAN + head + _DESCRIPTIONS[points.dtype] + steps + data + b"\1"


def contact_cloud(
    stamp_ns: int,
    frame: str,
    points: FloatArray,
    index: NDArray[np.integer],
    inclination: FloatArray,
    azimuth: FloatArray,
) -> bytes:
    """Contacts of one whisker frame.

    Args:
        stamp_ns: UNIX time.
        frame: the frame that the points are in.
        points: shape (m, 3), m.
        index: the whiskers' numbers in the layout, shape (m,).
        inclination, azimuth: shape (m,), rad.
    """
    packed = np.empty(len(points), dtype=CONTACT_POINT)
    packed["x"], packed["y"], packed["z"] = points[:, 0], points[:, 1], points[:, 2]
    packed["index"] = index
    packed["inclination"] = inclination
    packed["azimuth"] = azimuth
    return _cloud(stamp_ns, frame, packed)


def map_cloud(stamp_ns: int, frame: str, points: FloatArray, max_points: int = MAX_MAP_POINTS) -> bytes:
    """The map's points, shape (m, 3), m; more than `max_points` are thinned evenly."""
    if len(points) > max_points:
        points = points[np.linspace(0, len(points) - 1, max_points).astype(np.intp)]
    packed = np.ascontiguousarray(points, dtype="<f4").reshape(-1, 3).view(MAP_POINT)[:, 0]
    return _cloud(stamp_ns, frame, packed)
