"""The maps on the robot's disk: their list, and one of them fetched over the link in portions."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from robominer_slam import geometry
from robominer_slam.evaluation.trajectory import tum_line
from robominer_slam.map_files import point_files
from robominer_slam.publishing.bus_messages import QueryError
from robominer_slam.publishing.map_receiver import MapReceiver
from robominer_slam.publishing.map_state import MapState
from robominer_slam.publishing.zenoh_session import ZenohBus

SAVED = "map/saved"
LIST_TIMEOUT_S = 5.0
#: A map of 1 MB takes 64 kbit/s three minutes.
MAP_TIMEOUT_S = 600.0
TICK_S = 0.05


@dataclass(frozen=True, slots=True)
class SavedMapEntry:
    """A map in the list; `present`: the robot is in it."""

    number: int
    name: str
    created_unix_ns: int
    keyframes: int
    present: bool


def listed(bus: ZenohBus) -> list[SavedMapEntry]:
    """What is on the robot's disk, the newest first.

    Raises:
        QueryError: no answer, or one that cannot be read.
    """
    payload = bus.get(SAVED, timeout_s=LIST_TIMEOUT_S)[0].payload
    try:
        return [
            SavedMapEntry(
                int(one["id"]),
                str(one["name"]),
                int(one["created_unix_ns"]),
                int(one["keyframes"]),
                bool(one["present"]),
            )
            for one in json.loads(payload)["maps"]
        ]
    except (ValueError, KeyError, TypeError) as error:
        raise QueryError(f"the list of saved maps cannot be read: {error}") from error


def fetch(bus: ZenohBus, number: int, wanted: Callable[[], bool] = lambda: True) -> MapState:
    """One of them; waits until it is here.

    Args:
        bus: to ask on.
        number: from the list.
        wanted: asked meanwhile; False ends the waiting.

    Raises:
        QueryError: it did not come.
    """
    receiver = MapReceiver(bus, source=SAVED, parameters={"map": str(number)})
    end = time.monotonic() + MAP_TIMEOUT_S
    while (state := receiver.state) is None:
        if time.monotonic() > end or not wanted() or receiver.counters["unanswered"] > 1:
            raise QueryError(f"map {number} has not come: the robot has none such, or the link is cut")
        receiver.tick()
        time.sleep(TICK_S)
    return state


def _ply(state: MapState) -> bytes:
    return point_files.ply(state.cloud())


def _tum(state: MapState) -> bytes:
    keyframes = sorted(state.keyframes.values(), key=lambda one: one.stamp_ns)
    return "".join(tum_line(one.stamp_ns, geometry.from_vector7(one.vector7())) for one in keyframes).encode()


#: What a fetched map can be saved as, by the file's ending.
FORMATS: Mapping[str, Callable[[MapState], bytes]] = {"ply": _ply, "tum": _tum}
