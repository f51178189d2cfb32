"""A process of its own that hears the robot over Zenoh only, and writes down what it hears.

Started as `python -m sim_backend.listener`; on SIGTERM it asks for the graph and the map, writes them and ends. The
demo and the tests judge the daemon by these files, never from inside it.
"""

from __future__ import annotations

import json
import signal
import threading
from pathlib import Path
from typing import IO

import click
import numpy as np

from drivers.ros_messages import deserialize, time_to_ns
from robominer_slam import geometry
from robominer_slam.evaluation.trajectory import tum_line
from robominer_slam.publishing.bus_messages import QueryError, Received
from robominer_slam.publishing.pose_messages import ODOMETRY, POSE_WITH_COVARIANCE
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSettings

QUERY_TIMEOUT_S = 20.0


class PoseLog:
    """Poses of one key, appended to a TUM file as they come."""

    def __init__(self, file: IO[str], typename: str) -> None:
        self._file = file
        self._typename = typename
        self.count = 0

    def take(self, received: Received) -> None:
        """One message."""
        message = deserialize(received.payload, self._typename)
        p, q = message.pose.pose.position, message.pose.pose.orientation
        T = geometry.pose_matrix(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))
        self._file.write(tum_line(time_to_ns(message.header.stamp), T))
        self._file.flush()
        self.count += 1


def points_of_cloud(payload: bytes) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """x, y, z of a PointCloud2 of three float32, shape (m, 3)."""
    message = deserialize(payload, "sensor_msgs/msg/PointCloud2")
    return np.asarray(message.data, dtype=np.uint8).view("<f4").reshape(-1, message.point_step // 4)[:, :3]


@click.command()
@click.option("--connect", required=True, help="Endpoint of the daemon.")
@click.option("--robot", default="rm3", show_default=True, help="The robot's id.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Folder to write to.")
def main(connect: str, robot: str, out: Path) -> None:
    """Hear the robot until SIGTERM; write slam.tum, odometry.tum, then graph.json and cloud.npy."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    # The robot drives off soon after the daemon has begun to listen: the listener must not be a second late.
    retry = {"connect/retry": {"period_init_ms": 50, "period_max_ms": 100, "period_increase_factor": 1}}
    settings = ZenohSettings(connect=(connect,), mode="client", connect_timeout_s=30.0, further=retry)
    with (
        (out / "slam.tum").open("w", encoding="utf-8") as slam,
        (out / "odometry.tum").open("w", encoding="utf-8") as odometry,
        ZenohBus(settings, f"robominer/{robot}") as bus,
    ):
        bus.subscriber("pose", PoseLog(slam, POSE_WITH_COVARIANCE).take)
        bus.subscriber("odom", PoseLog(odometry, ODOMETRY).take)
        # Whoever started this process waits for the line before it lets the robot drive.
        click.echo("listening")
        stop.wait()
        try:
            graph = json.loads(bus.get("map/graph", timeout_s=QUERY_TIMEOUT_S)[0].payload)
            points = points_of_cloud(bus.get("map/cloud", timeout_s=QUERY_TIMEOUT_S)[0].payload)
        except QueryError as error:
            raise click.ClickException(str(error)) from error
    (out / "graph.json").write_text(json.dumps(graph), encoding="utf-8")
    np.save(out / "cloud.npy", points)


if __name__ == "__main__":
    main()
