"""The map and the way as files that other programs read: PLY, and trajectories as TUM text."""

from __future__ import annotations

from robominer_slam import geometry
from robominer_slam.evaluation.trajectory import tum_line
from robominer_slam.map_files import point_files
from robominer_slam.operator.robot_view import RobotView


def ply(view: RobotView) -> bytes:
    """The map's points, binary little-endian PLY, x y z in m in the map's frame."""
    with view.lock:
        return point_files.ply(view.map.cloud())


def keyframes_tum(view: RobotView) -> bytes:
    """The keyframes' poses as they are now, a TUM line each, by time."""
    with view.lock:
        poses = view.map.trajectory()
    lines = [tum_line(stamp, geometry.from_vector7(pose)) for stamp, pose in sorted(poses, key=lambda entry: entry[0])]
    return "".join(lines).encode()


def poses_tum(view: RobotView) -> bytes:
    """The poses as they were published, as far as this console kept them, a TUM line each."""
    with view.lock:
        frames = view.history.poses()
    return "".join(tum_line(stamp, geometry.from_vector7(pose)) for stamp, pose in frames).encode()
