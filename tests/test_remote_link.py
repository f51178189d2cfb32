"""Robot and operator in network namespaces, over 64 kbit/s with outages: poses in time, maps equal. Needs root."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.link_namespaces import Link, NamespacesError, why_not
from benchmarks.link_scenario import Scenario
from benchmarks.remote_link import line, topics


@pytest.fixture
def link() -> Iterator[Link]:
    missing = why_not()
    if missing and not os.environ.get("ROBOMINER_SLAM_CI"):
        pytest.skip(missing)
    assert not missing, missing
    try:
        made = Link(64.0)
    except NamespacesError as error:
        pytest.skip(f"a kernel or container without network namespaces: {error}")
    with made:
        yield made


def test_poses_are_in_time_and_the_map_is_equal_over_a_slow_link_with_outages(link: Link, tmp_path: Path) -> None:
    scenario = Scenario(tmp_path, link)
    # The whole map is corrected now and then: 150 poses at once.
    robot = scenario.synthetic("--keyframes", "150", "--step", "0.5", "--correct-every", "16")
    result = scenario.run(robot, [(16.0, 2.0), (3.0, 1.0)], settle_s=8.0)
    report = f"{line('test', result)}\n{topics(result)}"
    assert result.messages["telemetry"] > 60, report
    # In half of this time the map is still coming, or the link has just been away.
    assert result.late(50) < 0.5, report
    assert result.kbit_down < 64.0, report
    assert len(result.heard_s) == 2, report
    assert max(result.heard_s) < 10.0, report
    assert result.equal, report
    assert result.equal_s, report
    assert max(result.equal_s) < 20.0, report
    assert 0 < result.map_bytes < 250_000, report
