"""What a running simulation is asked for from outside: waypoints, and the end of the drive.

A request is one JSON object on one line, the reply another:

- `{"add_waypoint": [x, y, heading_deg]}`: drive there next, m, m, deg, in the world's frame, which is the map's. The
  reply is `{"waypoint": [x, y, heading_deg], "starts_s": s, "arrives_s": s}` in simulated time.
- `{"end": true}`: end once all waypoints have been driven; the reply is `{"ends_s": s}`.
- What cannot be done is answered by `{"error": "why"}` and changes nothing.
"""

from __future__ import annotations

import json
import math

import numpy as np

from sim_backend.extendable_path import ExtendablePath, PathClosedError
from sim_backend.scene import ARRAY_REACH, World

#: Distance of the places at which a way through galleries is looked at, m.
LOOK = 0.05


class RequestError(ValueError):
    """A request that cannot be followed; one line says why."""


class WaypointControl:
    """Answers requests for one drive."""

    def __init__(self, world: World, path: ExtendablePath) -> None:
        """Let `path` be extended within `world`."""
        self._world, self._path = world, path

    def answer(self, line: bytes) -> bytes:
        """The reply to a request, both one line of JSON; the reply with its line feed."""
        try:
            reply = self._follow(line)
        except (RequestError, PathClosedError) as error:
            reply = {"error": str(error)}
        return json.dumps(reply).encode() + b"\n"

    def _follow(self, line: bytes) -> dict[str, object]:
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            request = None
        if isinstance(request, dict):
            if request.keys() == {"add_waypoint"}:
                return self._add(request["add_waypoint"])
            if request == {"end": True}:
                return {"ends_s": self._path.finish()}
        raise RequestError('expected {"add_waypoint": [x, y, heading_deg]} or {"end": true}')

    def _add(self, waypoint: object) -> dict[str, object]:
        if not (
            isinstance(waypoint, list)
            and len(waypoint) == 3
            and all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in waypoint)
        ):
            raise RequestError("a waypoint is three numbers: x and y in m, heading in deg")
        if not all(abs(value) <= 1e9 for value in waypoint):
            raise RequestError("a waypoint is three finite numbers: x and y in m, heading in deg")
        x, y, heading = map(float, waypoint)
        self._check_place(x, y)
        leg = self._path.extend(x, y, math.radians(heading))
        return {"waypoint": [x, y, heading], "starts_s": leg.start, "arrives_s": leg.end}

    def _check_place(self, x: float, y: float) -> None:
        if self._world.walls is not None:
            last = self._path.last_waypoint()
            steps = 2 + int(math.hypot(x - last[0], y - last[1]) / LOOK)
            places = np.linspace(last[:2], [x, y], steps).T
            # Half a whisker above the floor: walls, and no bumps of the floor.
            height = self._world.height(*places) + 0.5 * ARRAY_REACH
            if (self._world.walls.gap(np.vstack([places, height]))[0] <= 0.0).any():
                raise RequestError(
                    f"waypoint {x:g} {y:g}: the straight way there from {last[0]:.2f} {last[1]:.2f} leads through rock"
                )
            return
        for name, value, (low, high) in zip("xy", (x, y), self._world.ground.extent, strict=True):
            if not low + ARRAY_REACH <= value <= high - ARRAY_REACH:
                raise RequestError(
                    f"waypoint {x:g} {y:g}: outside the ground of world {self._world.name!r}, expected {name} from "
                    f"{low + ARRAY_REACH:.2f} to {high - ARRAY_REACH:.2f}"
                )
