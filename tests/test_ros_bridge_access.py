"""Who sees what ROS is shown, through TLS with real certificates: it is as the robot's own keys are."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest
import zenoh

from robominer_slam.publishing.client_settings import client_settings
from robominer_slam.publishing.ros_bridge import RosSettings, ros_keys, ros_layout
from robominer_slam.publishing.zenoh_settings import open_session
from tests.ros_node import MESSAGES, MOUNTS, TOPICS
from tests.secured_robot import LIMIT_S, PREFIX, REFUSED_S, SecuredRobot

PATTERNS = {"ros2dds": "@/*/@ros2_lv/**", "rmw_zenoh": "@ros2_lv/0/**"}


@pytest.fixture(scope="module", params=["ros2dds", "rmw_zenoh"])
def robot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredRobot]:
    robot = SecuredRobot(tmp_path_factory.mktemp("secured"), ros=request.param)
    with robot.bus:
        robot.bus.latch("tf_static", MOUNTS)
        yield robot


def bridge_of(robot: SecuredRobot) -> Literal["none", "ros2dds", "rmw_zenoh"]:
    assert robot.settings.ros is not None
    return robot.settings.ros.bridge


def session_of(robot: SecuredRobot, name: str) -> zenoh.Session:
    return open_session(client_settings(robot.tls, robot.bundle(name), LIMIT_S))


def tokens(session: zenoh.Session, pattern: str, limit_s: float) -> list[str]:
    end = time.monotonic() + limit_s
    while True:
        replies = list(session.liveliness().get(pattern, timeout=0.5))
        found = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        if found or time.monotonic() > end:
            return found


@pytest.mark.parametrize("name", ["alice", "bob"])
def test_operators_and_viewers_see_the_topics(robot: SecuredRobot, name: str) -> None:
    with session_of(robot, name) as session:
        assert len(tokens(session, PATTERNS[bridge_of(robot)], LIMIT_S)) == 1 + len(TOPICS)


def test_who_was_revoked_sees_none(robot: SecuredRobot) -> None:
    with session_of(robot, "mallory") as session:
        assert tokens(session, PATTERNS[bridge_of(robot)], REFUSED_S) == []


def test_a_viewer_gets_the_copies_slowly_and_the_mounts_at_once(robot: SecuredRobot) -> None:
    layout = ros_layout(RosSettings(bridge_of(robot)), PREFIX)
    assert layout is not None
    key_of = {own: key for key, own in ros_keys(layout).items()}
    heard: queue.Queue[str] = queue.Queue()
    with session_of(robot, "bob") as session:
        moving = session.declare_subscriber(key_of["tf"], lambda s: heard.put(str(s.key_expr)))
        fixed = zenoh.ext.declare_advanced_subscriber(
            session,
            key_of["tf_static"],
            lambda s: heard.put(str(s.key_expr)),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        )
        seen: list[str] = []
        end = time.monotonic() + LIMIT_S
        sent = 0
        while set(seen) != {key_of["tf"], key_of["tf_static"]} or sent < 40:
            assert time.monotonic() < end, seen
            robot.bus.put("tf", MESSAGES["tf"])
            sent += 1
            try:
                seen.append(heard.get(timeout=0.02))
            except queue.Empty:
                continue
        # One in ten seconds, of the forty or more that were sent.
        assert seen.count(key_of["tf"]) <= 2
        moving.undeclare()
        fixed.undeclare()


def test_a_viewer_cannot_pose_as_a_node(robot: SecuredRobot) -> None:
    bridge = bridge_of(robot)
    pattern = PATTERNS[bridge]
    forged = pattern.replace("**", "forged").replace("*", "0123")
    with session_of(robot, "bob") as session:
        token = session.liveliness().declare_token(forged)
        # Programs on the robot see all that the robot lets in.
        own = open_session(client_settings(robot.tcp, None, LIMIT_S))
        assert forged not in tokens(own, pattern, LIMIT_S)
        honest = forged.replace("forged", "honest")
        other = own.liveliness().declare_token(honest)
        watching = open_session(client_settings(robot.tcp, None, LIMIT_S))
        end = time.monotonic() + LIMIT_S
        while honest not in (found := tokens(watching, pattern, LIMIT_S)):
            assert time.monotonic() < end
        assert forged not in found
        for entity in (token, other):
            entity.undeclare()
        watching.close()
        own.close()


def test_without_ros_nobody_sees_any(tmp_path: Path) -> None:
    plain = SecuredRobot(tmp_path)
    with plain.bus, session_of(plain, "alice") as session:
        robots = plain.bus._session.liveliness()
        token = robots.declare_token("@ros2_lv/0/something")
        assert tokens(session, "@ros2_lv/0/**", REFUSED_S) == []
        token.undeclare()
