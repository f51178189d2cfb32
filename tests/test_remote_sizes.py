"""What is too large for a slow remote link stays away from it, and comes within the machine."""

from __future__ import annotations

from pathlib import Path

import pytest

from robominer_slam.publishing.bus_messages import QueryError, Reply
from robominer_slam.publishing.tls_settings import REMOTE_ANSWER_BYTES
from tests.secured_robot import Inbox, SecuredRobot


@pytest.mark.parametrize("remote_ros", [False, True])
def test_large_answers_and_updates_stay_away_from_tls_links(tmp_path: Path, remote_ros: bool) -> None:
    robot = SecuredRobot(tmp_path, remote_ros=remote_ros)
    small, large = bytes(REMOTE_ANSWER_BYTES - 1000), bytes(REMOTE_ANSWER_BYTES + 1000)
    with robot.bus, robot.client("alice") as remote, robot.client(None) as local:
        robot.bus.queryable("map/graph", lambda _: Reply(large))
        robot.bus.queryable("map/grid", lambda _: Reply(small))
        assert local.get("map/graph")[0].payload == large
        assert remote.get("map/grid")[0].payload == small
        if remote_ros:
            assert remote.get("map/graph")[0].payload == large
        else:
            with pytest.raises(QueryError):
                remote.get("map/graph")
        far, near = (Inbox(bus, "map/updates", "path", "telemetry") for bus in (remote, local))
        far.synchronise(robot.bus)
        near.synchronise(robot.bus)
        for key, payload in (("path", bytes(5000)), ("map/updates", bytes(5000)), ("map/updates", b"last")):
            robot.bus.put(key, payload)
        for inbox, updates, path in ((near, True, True), (far, False, remote_ros)):
            # Each key has a thread of its own: what is to come is waited for.
            inbox.until(lambda one: one.payload == b"last")
            if path and not large_ones(inbox, "path"):
                inbox.until(lambda one: one.key == "path")
            assert large_ones(inbox, "map/updates") == updates
            assert large_ones(inbox, "path") == path


def large_ones(inbox: Inbox, key: str) -> bool:
    return any(one.key == key and len(one.payload) == 5000 for one in inbox.seen)
