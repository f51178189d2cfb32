"""The receiver of the map over real sessions whose link is cut, stalled and slowed: in the end the maps are equal."""

from __future__ import annotations

import time

import numpy as np

from robominer_slam.publishing.map_receiver import MapReceiver
from tests.broken_link import BrokenLink, WanderingRobot, client


def test_after_fifty_random_outages_the_map_is_the_robots() -> None:
    rng = np.random.default_rng(5)
    with WanderingRobot(5) as robot, BrokenLink(robot.port) as link, client(link) as bus:
        receiver = MapReceiver(bus)
        receiver.subscribe()
        link.bytes_per_s = 200_000.0
        missed = 0
        for _ in range(50):
            for broken in (True, False):
                if broken:
                    version = receiver.state.version if receiver.state else 0
                    (link.cut if rng.random() < 0.5 else link.stall)()
                for _ in range(int(rng.integers(1, 6))):
                    robot.step()
                    robot.tell()
                    receiver.tick()
                    time.sleep(0.02)
                if broken:
                    missed += robot.publisher.state.version > version
                    link.mend()
        robot.until_equal(receiver)
        assert receiver.state is not None
        assert receiver.state.version == robot.publisher.state.version
        assert receiver.behind == 0
    assert missed == 50, "every outage had something to miss"
    # Without the queries, the first cut would have been the end of the copy.
    assert receiver.counters["queries"] >= 2


def test_a_late_joiner_gets_the_whole_map_in_portions() -> None:
    with WanderingRobot(6, points=2000) as robot, BrokenLink(robot.port) as link:
        for _ in range(120):
            robot.step()
        with client(link) as bus:
            receiver = MapReceiver(bus)
            receiver.subscribe()
            link.bytes_per_s = 60_000.0
            robot.until_equal(receiver)
            size = receiver.counters["reply_bytes"]
            assert size > 50_000
            assert receiver.counters["queries"] >= 5
            assert receiver.counters["unanswered"] <= 1


def test_who_was_away_gets_what_it_missed_and_not_the_whole() -> None:
    with WanderingRobot(7, points=2000) as robot, BrokenLink(robot.port) as link:
        for _ in range(120):
            robot.step()
        with client(link) as bus:
            receiver = MapReceiver(bus)
            receiver.subscribe()
            robot.until_equal(receiver)
            whole = receiver.counters["reply_bytes"]
            link.cut()
            for _ in range(10):
                robot.step()
                robot.tell()
            link.mend()
            robot.until_equal(receiver)
            assert 0 < receiver.counters["reply_bytes"] - whole < whole / 3


def test_an_answer_that_was_cut_in_the_middle_goes_on_where_it_was() -> None:
    with WanderingRobot(8, points=2000) as robot, BrokenLink(robot.port) as link:
        for _ in range(120):
            robot.step()
        with client(link) as bus:
            receiver = MapReceiver(bus)
            receiver.subscribe()
            link.bytes_per_s = 20_000.0
            robot.until(lambda: receiver.counters["reply_bytes"] > 30_000, receiver)
            link.cut()
            robot.step()
            link.mend()
            link.bytes_per_s = None
            robot.until_equal(receiver)
            whole = sum(len(reply) for reply in robot.publisher._stream.snapshot())
            # One portion may have to come again, and the step of meanwhile.
            assert receiver.counters["reply_bytes"] < whole + 20_000
