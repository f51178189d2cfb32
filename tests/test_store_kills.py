"""The process that writes the map is killed at random moments: the next one starts, and nothing old is lost."""

from __future__ import annotations

from pathlib import Path

from tests.killed_writer import KilledWriter

SYNC_S = 0.6
#: What the machine of a test may be late.
MARGIN_S = 0.4


def test_killed_again_and_again_no_start_fails_and_no_old_keyframe_is_lost(tmp_path: Path):
    writer = KilledWriter(tmp_path / "map.db", SYNC_S, 0.02, seed=1)
    kills = [writer.kill() for _ in range(12)]
    assert sum(kill.made for kill in kills) > 100, "there was something to lose"
    assert any(not kill.started for kill in kills), "one was killed while it started"
    assert any(kill.lost for kill in kills), "kills come between commits"
    assert [kill.damage for kill in kills] == [""] * 12
    assert sum(kill.lost_before for kill in kills) == 0
    assert max(kill.lost_age_s for kill in kills) < SYNC_S + MARGIN_S
