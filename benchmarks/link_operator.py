"""An operator's program on the far end of the link: receives everything and says what it got. Run by remote_link.py.

    python -m benchmarks.link_operator --credentials FOLDER --connect tls/HOST:PORT

A line on its input makes it pause the robot's mapping, the end of its input ends it. Prints JSON lines: each message
with how late it is, and five times a second the state of the copy of the map.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from pathlib import Path

from drivers.ros_messages import deserialize
from robominer_slam.publishing import telemetry
from robominer_slam.publishing.bus_messages import Received
from robominer_slam.publishing.client_settings import client_settings
from robominer_slam.publishing.map_receiver import MapReceiver
from robominer_slam.publishing.pose_messages import POSE_WITH_COVARIANCE
from robominer_slam.publishing.report_messages import DIAGNOSTIC_ARRAY
from robominer_slam.publishing.zenoh_session import ZenohBus

PREFIX = "robominer/rm3"
TICK_S = 0.2
CONNECT_TIMEOUT_S = 20.0


class Log:
    """Writes lines from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def line(self, **values: object) -> None:
        """One line, at once."""
        with self._lock:
            print(json.dumps({"t": time.time(), **values}), flush=True)


def stamp_s(received: Received) -> float | None:
    """When the robot made a message, UNIX s."""
    if received.key == "telemetry":
        return telemetry.decode(received.payload).stamp_ns * 1e-9
    if received.key == "pose":
        stamp = deserialize(received.payload, POSE_WITH_COVARIANCE).header.stamp
        return float(stamp.sec) + float(stamp.nanosec) * 1e-9
    return None


def told_map(received: Received) -> dict[str, str]:
    """What a `status` says of the robot's map."""
    if received.key != "status":
        return {}
    entries = deserialize(received.payload, DIAGNOSTIC_ARRAY).status
    told = {value.key: value.value for entry in entries for value in entry.values}
    return {"robot_version": told.get("map.version", ""), "robot_digest": told.get("map.digest", "")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--credentials", type=Path)
    parser.add_argument("--connect", required=True)
    parser.add_argument("--map", choices=("receiver", "history", "whole", "none"), default="receiver")
    arguments = parser.parse_args()
    log, stop = Log(), threading.Event()
    pause = threading.Event()

    def read() -> None:
        for _ in sys.stdin:
            pause.set()
        stop.set()

    # Reading blocks: in a thread of its own.
    threading.Thread(target=read, name="input", daemon=True).start()
    with ZenohBus(client_settings(arguments.connect, arguments.credentials, CONNECT_TIMEOUT_S), PREFIX) as bus:
        receiver = MapReceiver(bus)

        def take(received: Received) -> None:
            stamp = stamp_s(received)
            late = None if stamp is None else round(time.time() - stamp, 4)
            log.line(key=received.key, bytes=len(received.payload), late=late, **told_map(received))
            receiver.take(received)

        for key in ("telemetry", "pose", "odom", "tf", "path", "whiskers/points", "status", "map/updates"):
            bus.subscriber(key, take, history=arguments.map == "history" and key == "map/updates")
        if arguments.map == "whole":
            # What a receiver without portions does, for comparison.
            begun = time.monotonic()
            size = sum(len(one.payload) for one in bus.get("map/snapshot", timeout_s=600.0))
            log.line(whole=size, took=time.monotonic() - begun)
        while not stop.wait(TICK_S):
            if arguments.map == "receiver":
                receiver.tick()
            if pause.is_set():
                pause.clear()
                log.line(paused=bus.get("cmd/pause")[0].payload.decode())
            state = receiver.state
            log.line(
                version=0 if state is None else state.version, digest=receiver.digest, behind=receiver.behind,
                synchronised=receiver.synchronised, counters=dict(receiver.counters),
            )  # fmt: skip


if __name__ == "__main__":
    main()
