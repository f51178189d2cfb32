"""`sim/waypoint` on the bus: an operator's console sends the simulated robot on, as `robominer-slam waypoint` does.

The simulation joins the daemon's endpoint as a client; only a robot that is simulated answers this key.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import threading
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from robominer_slam.publishing.bus_messages import Query, Reply
from robominer_slam.publishing.keys import JSON
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSettings, ZenohSetupError
from sim_backend.control_socket import NoSimulationError, ask

log = logging.getLogger(__name__)

KEY = "sim/waypoint"
#: How long one attempt to reach the daemon takes at most, s; there are more until one succeeds.
ATTEMPT_S = 1.0
#: Answers kept by id, so that a repeat drives nowhere twice.
REMEMBERED = 64


class WaypointService:
    """Answers `sim/waypoint?x=;y=;yaw=` (m, rad) once the daemon listens; use it with `with`.

    A query without parameters only asks whether waypoints are taken.
    """

    def __init__(self, folder: Path, endpoint: str, robot: str, *, ends: bool) -> None:
        """Begin to look for the daemon.

        Args:
            folder: of the simulation, whose control socket takes the waypoints.
            endpoint: of the daemon.
            robot: the robot's id.
            ends: whether the drive is over once the last waypoint has been driven.
        """
        self._folder, self._endpoint, self._prefix, self._ends = folder, endpoint, f"robominer/{robot}", ends
        self._answers: dict[str, bytes] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="sim-waypoint", daemon=True)
        self._thread.start()

    def __enter__(self) -> WaypointService:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()

    def _serve(self) -> None:
        settings = ZenohSettings(connect=(self._endpoint,), mode="client", connect_timeout_s=ATTEMPT_S)
        while not self._stop.is_set():
            try:
                bus = ZenohBus(settings, self._prefix)
            except ZenohSetupError as error:
                log.debug("the daemon does not listen yet: %s", error)
                self._stop.wait(0.2)
                continue
            with contextlib.closing(bus):
                bus.queryable(KEY, self._answer)
                self._stop.wait()

    def _answer(self, query: Query) -> Reply:
        identity = query.parameters.get("id", "")
        if identity not in self._answers or not identity:
            ok, message = self._drive(query.parameters)
            answer = json.dumps({"ok": ok, "message": message}).encode()
            if not identity:
                return Reply(answer, JSON)
            while len(self._answers) >= REMEMBERED:
                del self._answers[next(iter(self._answers))]
            self._answers[identity] = answer
        return Reply(self._answers[identity], JSON)

    def _drive(self, parameters: Mapping[str, str]) -> tuple[bool, str]:
        if not parameters:
            return True, "a simulated robot: it takes waypoints"
        try:
            x, y, yaw = (float(parameters[name]) for name in ("x", "y", "yaw"))
        except (KeyError, ValueError):
            return False, "expected x= and y= in m, yaw= in rad"
        reply = self._ask({"add_waypoint": [x, y, math.degrees(yaw)]})
        if "error" in reply:
            return False, str(reply["error"])
        if self._ends:
            self._ask({"end": True})
        return True, f"driven from {reply['starts_s']:.1f} s to {reply['arrives_s']:.1f} s of simulated time"

    def _ask(self, request: Mapping[str, object]) -> dict[str, Any]:
        try:
            reply: dict[str, Any] = json.loads(ask(self._folder, json.dumps(request).encode()))
        except NoSimulationError as error:
            return {"error": str(error)}
        return reply
