"""OccupancyGrid, on query, by a general serialiser; and DiagnosticArray, each second.

The latter is packed by hand: a hundred strings by the general serialiser cost the board as much as five frames do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Sized
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers import cdr
from drivers.ros_messages import header, new, serialize, time_from_ns

OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
DIAGNOSTIC_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"

#: Zeros up to a multiple of four, by the remainder.
_PADDING = (b"", bytes(3), bytes(2), bytes(1))


class Level(IntEnum):
    """diagnostic_msgs/DiagnosticStatus: how bad it is."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Diagnostic(NamedTuple):
    """One part of the program: how it is, and figures; `hardware_id` names a device where it is one."""

    name: str
    level: Level
    message: str
    values: Mapping[str, str]
    hardware_id: str = ""


def occupancy_grid(
    stamp_ns: int, frame: str, resolution: float, origin: tuple[float, float], cells: NDArray[np.int8]
) -> bytes:
    """nav_msgs/OccupancyGrid.

    Args:
        stamp_ns: UNIX time.
        frame: the frame that the grid lies in.
        resolution: side of a cell, m.
        origin: x, y of the outer corner of cell [0, 0], m.
        cells: shape (height, width), rows along y, columns along x; 0 free to 100 occupied, -1 unknown.
    """
    height, width = cells.shape
    pose = new(
        "geometry_msgs/msg/Pose",
        position=new("geometry_msgs/msg/Point", x=float(origin[0]), y=float(origin[1]), z=0.0),
        orientation=new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
    info = new(
        "nav_msgs/msg/MapMetaData",
        map_load_time=time_from_ns(stamp_ns),
        resolution=float(resolution),
        width=width,
        height=height,
        origin=pose,
    )
    data = np.ascontiguousarray(cells, dtype=np.int8).ravel()
    message = new(OCCUPANCY_GRID, header=header(stamp_ns, frame), info=info, data=data)
    return serialize(message, OCCUPANCY_GRID)


def diagnostics(stamp_ns: int, content: Sequence[Diagnostic]) -> bytes:
    """diagnostic_msgs/DiagnosticArray."""
    data = bytearray(cdr.stamp(stamp_ns))
    _add(data, "")
    _count(data, content)
    for entry in content:
        data.append(int(entry.level))
        for text in (entry.name, entry.message, entry.hardware_id):
            _add(data, text)
        _count(data, entry.values)
        for pair in entry.values.items():
            for text in pair:
                _add(data, text)
    return cdr.CDR_LITTLE_ENDIAN + bytes(data)


def _count(data: bytearray, sequence: Sized) -> None:
    data += cdr.padding(len(data), 4) + cdr.UINT32.pack(len(sequence))


def _add(data: bytearray, text: str) -> None:
    """What `cdr.string` would, with less copying."""
    encoded = text.encode()
    data += _PADDING[len(data) % 4]
    data += cdr.UINT32.pack(len(encoded) + 1)
    data += encoded
    data.append(0)
