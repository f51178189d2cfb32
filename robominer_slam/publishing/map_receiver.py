"""A receiver of the map: keeps a copy equal to the robot's over a link that is slow and breaks. No thread of its own.

Updates are taken as they come. What is missing is asked for by queries of `map/snapshot`, one at a time, in portions
small enough that poses are not held up behind them; how much the robot has is known from `telemetry` and `status`.
Zenoh's own history is not used: after each outage it would send up to 256 messages again, most of them known.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Protocol

from drivers.counters import Counters
from drivers.ros_messages import deserialize
from robominer_slam.publishing import telemetry
from robominer_slam.publishing.bus_messages import Received
from robominer_slam.publishing.map_records import MapStreamError, unpack_messages
from robominer_slam.publishing.map_state import MapState
from robominer_slam.publishing.map_stream_decoder import MapStreamDecoder
from robominer_slam.publishing.report_messages import DIAGNOSTIC_ARRAY

SNAPSHOT = "map/snapshot"
KEYS = ("map/updates", "telemetry", "status")
#: Telemetry overtakes updates: only who is behind for so long has lost something, s.
GRACE_S = 1.5
#: Of a portion, bytes; it grows while portions come within FAST_S, and shrinks when they take longer than SLOW_S.
MIN_PORTION, MAX_PORTION = 4096, 128 * 1024
FAST_S, SLOW_S = 0.2, 0.5
#: A query is given up after so long: more than an outage of a few seconds with TCP's pause after it; doubled at each
#: time in a row that nothing came.
TIMEOUT_S, MAX_TIMEOUT_S = 6.0, 12.0
#: After a query without an answer the next one waits so long, doubled each time; the robot's next message ends it.
PAUSE_S, MAX_PAUSE_S = 0.5, 8.0
#: Nothing heard for so long: the link is gone.
SILENCE_S = 2.0
#: Zenoh ends every query at its time-out; this much later we no longer believe it.
_MARGIN_S = 5.0


class Asking(Protocol):
    """What the receiver needs of a `ZenohBus`."""

    def subscriber(self, key: str, callback: Callable[[Received], None]) -> None:
        """Call back with every message."""

    def ask(
        self,
        key: str,
        parameters: Mapping[str, str],
        on_reply: Callable[[Received], None],
        on_end: Callable[[], None],
        timeout_s: float,
    ) -> None:
        """Ask, and do not wait."""


class MapReceiver:
    """Keeps a copy of a robot's map. Safe to use from several threads.

    The owner calls `tick` a few times a second, and either `subscribe` once or `take` with messages it has anyway.

    Attributes:
        counters: `queries`, those `unanswered`, `reply_bytes`, `update_bytes`, `unreadable` messages.
    """

    def __init__(
        self,
        bus: Asking,
        on_change: Callable[[MapState], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
        source: str = SNAPSHOT,
        parameters: Mapping[str, str] | None = None,
    ) -> None:
        """Start without a copy.

        Args:
            bus: to ask on.
            on_change: called with each new state, in the thread that brought it, one after the other.
            clock: monotonic time, s.
            source: key of the queries.
            parameters: of every query, beside its own.
        """
        self.counters = Counters()
        self._bus = bus
        self._on_change = on_change
        self._clock = clock
        self._source, self._parameters = source, dict(parameters or {})
        self._lock = threading.Lock()
        #: Held from taking a message until the owner has the state that came of it, so that none overtakes another.
        self._feeding = threading.Lock()
        self._decoder = MapStreamDecoder()
        self._heard_version: int | None = None
        self._heard_digest: tuple[int, str] | None = None
        self._heard_s = self._behind_s = -float("inf")
        #: The answer that is being fetched in portions, by name.
        self._fetching: str | None = None
        #: Number of the query under way, counted from 1; 0: none. Late ends of others mean nothing.
        self._asked, self._under_way = 0, 0
        self._asked_s, self._resume_s = -float("inf"), -float("inf")
        self._got_bytes = 0
        self._timeout_s, self._pause_s = TIMEOUT_S, PAUSE_S
        self._portion = MIN_PORTION

    def subscribe(self) -> None:
        """Receive what is needed from the bus."""
        for key in KEYS:
            self._bus.subscriber(key, self.take)

    @property
    def state(self) -> MapState | None:
        """The newest map that is whole; None before the first."""
        with self._lock:
            return self._decoder.state

    @property
    def digest(self) -> str | None:
        """Of the copy, as `status` tells it of the robot's map."""
        state = self.state
        return None if state is None else state.digest().hex()

    @property
    def behind(self) -> int | None:
        """Versions that the robot's map is known to be ahead; None where either is not known."""
        with self._lock:
            if self._decoder.state is None or self._heard_version is None:
                return None
            return max(0, self._heard_version - self._decoder.state.version)

    @property
    def synchronised(self) -> bool:
        """Whether the copy is the map that the robot told of last; old news where the link is down."""
        with self._lock:
            return self._decoder.state is not None and not self._differs(self._decoder.state)

    def take(self, received: Received) -> None:
        """Take a message of `map/updates`, `telemetry` or `status`; others are ignored."""
        if received.key == "map/updates":
            self._feed(received.payload, "update_bytes")
        elif received.key == "telemetry":
            try:
                self.heard(telemetry.decode(received.payload).map_version)
            except telemetry.TelemetryError:
                self.counters["unreadable"] += 1
        elif received.key == "status":
            for entry in deserialize(received.payload, DIAGNOSTIC_ARRAY).status:
                values = {value.key: value.value for value in entry.values}
                if "map.version" in values:
                    self.heard(int(values["map.version"]), values.get("map.digest"))

    def heard(self, version: int, digest: str | None = None) -> None:
        """The robot has told which version of the map it has, and perhaps its digest."""
        with self._lock:
            self._alive()
            self._heard_version = version
            if digest is not None:
                self._heard_digest = (version, digest)

    def tick(self) -> None:
        """Ask for what is missing, if it is time; does not wait."""
        with self._lock:
            now = self._clock()
            if self._under_way and now - self._asked_s > self._timeout_s + _MARGIN_S:
                self._ended(now)
            wanted = self._wanted(now)
            if wanted is None:
                return
            self._asked += 1
            number = self._under_way = self._asked
            self._asked_s, self._got_bytes = now, 0
            timeout_s = self._timeout_s
            self.counters["queries"] += 1
        wanted |= self._parameters
        self._bus.ask(
            self._source, wanted, lambda received: self._reply(received), lambda: self._end(number), timeout_s
        )

    def _wanted(self, now: float) -> dict[str, str] | None:
        """Parameters of the query that is due."""
        if self._under_way or now < self._resume_s:
            return None
        decoder = self._decoder
        state = decoder.state
        self._behind_s = now if state is not None and not self._differs(state) else self._behind_s
        copy = {name: str(number) for name, number in decoder.copy.items()} | {"limit": str(self._portion)}
        if self._fetching is not None:
            return {**copy, "answer": self._fetching, "part": str(decoder.first_missing(self._fetching) or 0)}
        if state is None or decoder.needs_snapshot or now - self._behind_s > GRACE_S:
            return copy
        return None

    def _differs(self, state: MapState) -> bool:
        if self._heard_version is None:
            return True
        if self._heard_version != state.version:
            return True
        told = self._heard_digest
        return told is not None and told[0] == state.version and told[1] != state.digest().hex()

    def _alive(self) -> None:
        """A message has come: after a silence there is no reason to wait any longer."""
        now = self._clock()
        if now - self._heard_s > SILENCE_S:
            self._resume_s, self._pause_s, self._timeout_s = now, PAUSE_S, TIMEOUT_S
        self._heard_s = now

    def _reply(self, received: Received) -> None:
        with self._lock:
            self._got_bytes += len(received.payload)
        self._feed(received.payload, "reply_bytes")
        try:
            header, _ = next(unpack_messages(received.payload))
        except (MapStreamError, StopIteration):
            return
        with self._lock:
            if self._fetching not in (None, header.name):
                # The robot no longer has what we were fetching, and has begun anew.
                self._decoder.forget(self._fetching or "")
            self._fetching = header.name

    def _end(self, number: int) -> None:
        with self._lock:
            if number != self._under_way:
                return
            self._ended(self._clock())
        # The next portion at once.
        self.tick()

    def _ended(self, now: float) -> None:
        """No more comes of the query under way."""
        self._under_way = 0
        if not self._got_bytes:
            self.counters["unanswered"] += 1
            self._resume_s = now + self._pause_s
            self._pause_s = min(2.0 * self._pause_s, MAX_PAUSE_S)
            self._timeout_s = min(2.0 * self._timeout_s, MAX_TIMEOUT_S)
            self._portion = MIN_PORTION
            return
        self._timeout_s, self._pause_s, self._behind_s = TIMEOUT_S, PAUSE_S, now
        took_s = now - self._asked_s
        if took_s < FAST_S:
            self._portion = min(2 * self._portion, MAX_PORTION)
        elif took_s > SLOW_S:
            self._portion = max(self._portion // 2, MIN_PORTION)
        self._go_on()

    def _go_on(self) -> None:
        """See whether the answer under way has more to it."""
        if self._fetching is None:
            return
        if self._decoder.first_missing(self._fetching) is not None:
            return
        # It was taken, which is the rule; or it is complete, and the copy has gone another way meanwhile.
        self._decoder.forget(self._fetching)
        self._fetching = None

    def _feed(self, payload: bytes, counter: str) -> None:
        with self._feeding:
            with self._lock:
                self._alive()
                self.counters[counter] += len(payload)
                changed = self._decoder.feed(payload)
                state = self._decoder.state
                if changed:
                    self._behind_s = self._clock()
            if changed and state is not None and self._on_change is not None:
                self._on_change(state)
