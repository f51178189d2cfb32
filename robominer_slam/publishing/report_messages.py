"""What is published seldom or on query: OccupancyGrid and DiagnosticArray, by a general serialiser."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.ros_messages import header, new, serialize, time_from_ns

OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
DIAGNOSTIC_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"
_STATUS = "diagnostic_msgs/msg/DiagnosticStatus"
_KEY_VALUE = "diagnostic_msgs/msg/KeyValue"


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
    status = [
        new(
            _STATUS,
            level=int(entry.level),
            name=entry.name,
            message=entry.message,
            hardware_id=entry.hardware_id,
            values=[new(_KEY_VALUE, key=key, value=value) for key, value in entry.values.items()],
        )
        for entry in content
    ]
    message = new(DIAGNOSTIC_ARRAY, header=header(stamp_ns, ""), status=status)
    return serialize(message, DIAGNOSTIC_ARRAY)
