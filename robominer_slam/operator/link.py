"""The link to a live robot: subscriptions and queries over Zenoh fill a `RobotView`. Knows nothing of the page.

Zenoh brings a lost link back by itself; what was missed of the map is fetched (`MapReceiver`), the rest comes with the
robot's next messages. A thread, `operator-link`, asks for what has to be asked for: the array's mounts, the map, the
loop closures, and whether the robot is simulated and takes waypoints.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from uuid import uuid4

from drivers.ros_messages import MessageError
from robominer_slam.operator import array_model, live_frame, saved_maps, status_entries
from robominer_slam.operator.commands import CommandResult, Outcome, result_of
from robominer_slam.operator.robot_view import RobotView
from robominer_slam.operator.saved_maps import SavedMapEntry
from robominer_slam.publishing import telemetry
from robominer_slam.publishing.bus_messages import QueryError, Received
from robominer_slam.publishing.map_receiver import MapReceiver
from robominer_slam.publishing.map_state import MapState
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSettings

log = logging.getLogger(__name__)

#: A whole map may be large, and comes from the robot that we chose to connect to.
MAX_MESSAGE_BYTES = 64 << 20
COMMAND_TIMEOUT_S = 8.0
QUERY_TIMEOUT_S = 5.0
TICK_S = 0.2
#: What is asked for and does not come is asked for again after this long, s.
RETRY_S = 2.0
#: The closures are asked for at most so often: they may be many, and the link slow.
CLOSURES_INTERVAL_S = 3.0
SIMULATOR_INTERVAL_S = 3.0

#: Keys that tell where the robot is.
LIVE_KEYS = frozenset({"pose", "telemetry"})
KEYS = ("pose", "telemetry", "status", "whiskers/points", "map/updates")


class RobotLink:
    """Keeps a view up to date from a robot's messages; use it with `with`.

    Attributes:
        view: what is known.
        robot: its id.
    """

    def __init__(self, settings: ZenohSettings, robot: str, view: RobotView | None = None) -> None:
        """Open the session.

        Args:
            settings: how to join the network; a console is a client.
            robot: the robot's id.
            view: to be filled.

        Raises:
            ZenohSetupError: nobody is there.
        """
        self.view = view or RobotView()
        self.robot = robot
        self._taps: list[Callable[[Received], None]] = []
        self._stop = threading.Event()
        self._due: dict[str, float] = {}
        self._mounts_known = False
        self._closures_of: tuple[int, int] | None = None
        self._bus = ZenohBus(settings, f"robominer/{robot}")
        self._receiver = MapReceiver(self._bus, self.view.take_map)
        handlers = {
            "pose": self._on_pose,
            "telemetry": self._on_telemetry,
            "status": self._on_status,
            "whiskers/points": self._on_points,
            "map/updates": self._receiver.take,
        }
        for key in KEYS:
            self._bus.subscriber(key, self._counted(handlers[key]))
        self._thread = threading.Thread(target=self._ask_again, name="operator-link", daemon=True)
        self._thread.start()

    def __enter__(self) -> RobotLink:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the network."""
        self._stop.set()
        self._thread.join(QUERY_TIMEOUT_S + 1.0)
        self._bus.close()

    @property
    def bus(self) -> ZenohBus:
        """The session, for what else listens to the robot in this process."""
        return self._bus

    def tap(self, callback: Callable[[Received], None]) -> None:
        """Also hand every message that is received to `callback`, in the thread that received it."""
        self._taps.append(callback)

    def command(self, name: str, parameters: Mapping[str, str]) -> CommandResult:
        """Ask the robot to do something; waits for its answer. A repeat on the way does nothing twice.

        Args:
            name: of `cmd/<name>`, or a whole key such as `sim/waypoint`.
            parameters: go into the selector.
        """
        key = name if "/" in name else f"cmd/{name}"
        try:
            replies = self._bus.get(key, {**parameters, "id": uuid4().hex}, timeout_s=COMMAND_TIMEOUT_S)
        except QueryError as error:
            result = CommandResult(
                Outcome.UNANSWERED,
                f"no answer from the robot ({error}): the link is cut, or this console may look on but not command",
            )
        else:
            result = result_of(replies[0].payload)
        self.view.note(f"command {name}: {result.outcome.value}: {result.message}")
        return result

    def saved_maps(self) -> list[SavedMapEntry]:
        """Maps on the robot's disk, the newest first; waits for its answer.

        Raises:
            QueryError: no answer.
        """
        return saved_maps.listed(self._bus)

    def saved_map(self, number: int) -> MapState:
        """One of them; waits until it is here.

        Raises:
            QueryError: it did not come.
        """
        return saved_maps.fetch(self._bus, number, lambda: not self._stop.is_set())

    def _counted(self, handler: Callable[[Received], None]) -> Callable[[Received], None]:
        def take(received: Received) -> None:
            with self.view.lock:
                self.view.traffic.count(
                    received.key, len(received.payload), time.monotonic(), live=received.key in LIVE_KEYS
                )
            for callback in self._taps:
                callback(received)
            try:
                handler(received)
            except (MessageError, telemetry.TelemetryError) as error:
                log.warning("a message on %s cannot be read: %s", received.key, error)

        return take

    def _on_pose(self, received: Received) -> None:
        self.view.take_pose(*live_frame.pose_of(received.payload))

    def _on_telemetry(self, received: Received) -> None:
        message = telemetry.decode(received.payload)
        self._receiver.heard(message.map_version)
        self.view.take_telemetry(message)

    def _on_status(self, received: Received) -> None:
        self._receiver.take(received)
        self.view.take_status(status_entries.entries_of(received.payload))

    def _on_points(self, received: Received) -> None:
        layout = self.view.layout
        if layout is not None:
            self.view.take_angles(*live_frame.contacts_of(received.payload, layout.count))

    def _ask_again(self) -> None:
        while not self._stop.wait(TICK_S):
            heard = self.view.telemetry
            if heard is None and self.view.live is None:
                continue
            self._receiver.tick()
            if not self._mounts_known:
                self._try("mounts", RETRY_S, self._ask_mounts)
            if heard is not None and self._closures_wanted(heard.closures):
                self._try("closures", CLOSURES_INTERVAL_S, self._ask_closures)
            self._try("simulator", SIMULATOR_INTERVAL_S, self._ask_simulator)

    def _try(self, name: str, interval_s: float, ask: Callable[[], None]) -> None:
        """Ask if it is due; who does not answer is asked again later."""
        now = time.monotonic()
        if now < self._due.get(name, 0.0):
            return
        try:
            ask()
        except QueryError as error:
            log.debug("%s: %s", name, error)
        self._due[name] = time.monotonic() + interval_s

    def _ask_mounts(self) -> None:
        heard = self.view.telemetry
        rows, cols = (0, 0) if heard is None else heard.inclination.shape
        reply = self._bus.get("tf_static", timeout_s=QUERY_TIMEOUT_S)[0]
        layout = array_model.layout_of_mounts(reply.payload, rows, cols)
        if layout is not None:
            self._mounts_known = True
            self.view.take_layout(layout)

    def _closures_wanted(self, closures: int) -> bool:
        return self._closures_of != (self.view.map.map_id, closures)

    def _ask_closures(self) -> None:
        heard = self.view.telemetry
        asked = (self.view.map.map_id, 0 if heard is None else heard.closures)
        pairs: list[tuple[int, int]] = []
        total = 1
        while len(pairs) < total:
            reply = self._bus.get("map/closures", {"first": str(len(pairs))}, timeout_s=QUERY_TIMEOUT_S)[0]
            answer = json.loads(reply.payload)
            total = answer["total"] if answer["pairs"] else 0
            pairs += [(i, j) for i, j in answer["pairs"]]
        self.view.take_closures(pairs)
        self._closures_of = asked

    def _ask_simulator(self) -> None:
        try:
            self.view.waypoints = bool(self._bus.get("sim/waypoint", timeout_s=1.0))
        except QueryError:
            self.view.waypoints = False
