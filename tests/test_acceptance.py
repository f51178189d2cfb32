"""The acceptance table on made runs."""

from __future__ import annotations

import dataclasses

import pytest

from robominer_slam.evaluation.acceptance import acceptance_table, is_worse, text_tables
from robominer_slam.evaluation.consistency import Consistency
from robominer_slam.evaluation.height_errors import HeightErrors
from robominer_slam.evaluation.metrics import ErrorStatistics
from robominer_slam.evaluation.run_record import ClosureCounts, DriveName, ResultsError, RunKey, RunRecord


def statistics(mean: float, largest: float | None = None) -> ErrorStatistics:
    return ErrorStatistics(mean, mean, mean, mean if largest is None else largest, mean)


def run(
    method: str = "thesis",
    *,
    seed: int | None = 0,
    source: str = "odometry",
    variant: str = "",
    mean: float = 0.1,
    largest: float = 0.3,
    odometry: float = 0.1,
    true: int = 6,
    wrong: int = 0,
    height: tuple[float, float] | None = None,
    share: float = 0.9,
    ratio: float | None = 1.0,
    frames: int = 100,
    replay_s: float = 1.0,
    drive: str = "scenario 3",
) -> RunRecord:
    return RunRecord(
        key=RunKey(drive, seed, method, source, variant),
        recording="scenario-3",
        frames=frames,
        duration_s=20.0,
        distance_m=5.0,
        replay_s=replay_s,
        cpu_s=replay_s,
        slam_position_m=statistics(mean, largest),
        slam_heading_deg=statistics(2.0),
        odometry_position_m=statistics(odometry),
        odometry_heading_deg=statistics(3.0),
        slam_distance_m=statistics(mean),
        slam_rotation_deg=statistics(2.0),
        slam_relative_m=None,
        odometry_relative_m=None,
        keyframes=10,
        closures=ClosureCounts(true + wrong, true, wrong),
        height=None if height is None else HeightErrors(100, 120, 0.0, *height, height[0]),
        consistency=Consistency(share, ratio, 0.1),
        states={"tracking": 1.0},
    )


def test_a_row_of_two_runs():
    runs = [
        run(mean=0.1, largest=0.3, wrong=1, true=5, height=(0.004, 0.002), share=1.0, ratio=1.0, frames=300),
        run(seed=1, mean=0.3, largest=0.9, wrong=2, true=4, height=(0.008, 0.004), share=0.6, ratio=2.0, replay_s=4.0),
    ]
    (row,) = acceptance_table(runs)
    assert (row.method, row.source, row.variant, row.runs) == ("thesis", "odometry", "", 2)
    assert row.mean_m == pytest.approx(0.2)
    assert (row.worst_mean_m, row.worst_moment_m) == (0.3, 0.9)
    assert (row.wrong_closures, row.runs_with_closures) == (3, 1)
    assert (row.height_rms_mm, row.height_median_mm) == (pytest.approx(6.0), pytest.approx(3.0))
    assert row.consistency == pytest.approx((300 * 1.0 + 100 * 0.6) / 400)
    assert row.sigma_ratio == pytest.approx(1.5)
    assert row.real_time_factor == pytest.approx((20.0 + 5.0) / 2)
    assert row.heading_deg == pytest.approx(2.0)


def test_worse_needs_both_five_percent_and_five_millimetres():
    assert is_worse(0.211, 0.2)
    assert not is_worse(0.2099, 0.2)
    assert not is_worse(0.0149, 0.01)
    assert is_worse(0.0151, 0.01)
    assert not is_worse(0.1, 0.2)


def test_a_method_is_held_against_the_raw_odometry_of_the_same_conditions():
    """The method's own odometry is worse than the raw one: it must not hide behind it."""
    runs = [
        run("none", mean=0.1, odometry=0.1),
        run("none", seed=1, mean=0.5, odometry=0.5),
        run("robust", mean=0.2, odometry=0.3),
        run("robust", seed=1, mean=0.4, odometry=0.3),
    ]
    none, robust = acceptance_table(runs)
    assert (none.worse_than_odometry, none.worse_than_own_odometry) == (0, 0)
    assert (robust.worse_than_odometry, robust.worse_than_own_odometry) == (1, 1)


def test_without_none_the_thesis_has_the_raw_odometry_and_without_both_nobody_has():
    _, robust = acceptance_table([run("thesis", odometry=0.1), run("robust", mean=0.2, odometry=0.3)])
    assert robust.worse_than_odometry == 1
    (alone,) = acceptance_table([run("robust", mean=0.2, odometry=0.3)])
    assert alone.worse_than_odometry is None
    assert alone.worse_than_own_odometry == 0


def test_rows_by_source_method_and_variant():
    runs = [
        run("none", source="fused"), run("none"), run("thesis", source="fused"), run("thesis"),
        run("thesis", variant="no kernel"), run("thesis", seed=1),
    ]  # fmt: skip
    rows = acceptance_table(runs)
    assert [(row.source, row.method, row.variant, row.runs) for row in rows] == [
        ("fused", "none", "", 1), ("fused", "thesis", "", 1), ("odometry", "none", "", 1),
        ("odometry", "thesis", "", 2), ("odometry", "thesis", "no kernel", 1),
    ]  # fmt: skip


def test_the_printed_table_says_what_the_rows_say():
    rows = acceptance_table([run("none", ratio=None), run("thesis", mean=0.12345, variant="a")])
    (table,) = text_tables(rows)
    assert table.columns == ["none", "thesis, a"]
    lines = dict(table.lines)
    assert lines["mean position error (m)"] == ["0.1000", "0.1235"]
    assert lines["median sigma / median error"] == ["-", "1.00"]
    assert not any("height" in name for name in lines), "nobody has a map with a known surface"


def test_a_record_survives_json():
    record = run(height=(0.004, 0.002))
    record = dataclasses.replace(record, frame_s=statistics(0.001), slam_relative_m=statistics(0.01))
    assert RunRecord.from_dict(record.as_dict()) == record
    with pytest.raises(ResultsError, match="not a run's record"):
        RunRecord.from_dict({**record.as_dict(), "surprise": 1})


@pytest.mark.parametrize(
    ("stem", "metadata", "expected"),
    [
        ("x", {"world": "thesis", "scenario": "3", "seed": "1", "odometry_seed": "7"}, ("scenario 3", 7)),
        ("x", {"world": "random:2", "scenario": "1", "seed": "4"}, ("random:2, scenario 1, seed 4", None)),
        ("scenario-3-odometry-7", {}, ("scenario 3", 7)),
        ("scenario_4", {}, ("scenario 4", None)),
        ("field-trip-seed3", {}, ("field-trip", 3)),
        ("field trip", {}, ("field trip", None)),
    ],
)
def test_drives_are_named_by_metadata_or_else_by_file(stem, metadata, expected):
    name = DriveName.of(stem, metadata)
    assert (name.drive, name.odometry_seed) == expected
