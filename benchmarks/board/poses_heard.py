"""Listens for the daemon's poses: `poses_heard.py ENDPOINT SECONDS`; exits 1 without any in that time."""

from __future__ import annotations

import queue
import sys
import time

from drivers.ros_messages import deserialize
from robominer_slam.publishing.bus_messages import Received
from robominer_slam.publishing.client_settings import client_settings
from robominer_slam.publishing.pose_messages import POSE_WITH_COVARIANCE
from robominer_slam.publishing.zenoh_session import ZenohBus

LISTEN_S = 10.0


def main() -> None:
    """Print when the first came, and how many in ten seconds."""
    endpoint, patience_s = sys.argv[1], float(sys.argv[2])
    heard: queue.Queue[Received] = queue.Queue()
    begin = time.monotonic()
    with ZenohBus(client_settings(endpoint, timeout_s=patience_s), "robominer/rm3") as bus:
        bus.subscriber("pose", heard.put)
        try:
            first = heard.get(timeout=patience_s)
        except queue.Empty:
            sys.exit(f"no pose within {patience_s:.0f} s")
        came_s = time.monotonic() - begin
        position = deserialize(first.payload, POSE_WITH_COVARIANCE).pose.pose.position
        time.sleep(LISTEN_S)
    print(
        f"first pose after {came_s:.1f} s: x {position.x:.3f} m, y {position.y:.3f} m; "
        f"{heard.qsize() / LISTEN_S:.0f} a second"
    )


if __name__ == "__main__":
    main()
