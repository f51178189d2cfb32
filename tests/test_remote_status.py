"""`status` for a slow link: when it goes, and that it is never more than 400 bytes."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from drivers.ros_messages import deserialize
from robominer_slam.publishing.report_messages import DIAGNOSTIC_ARRAY, Diagnostic, Level
from robominer_slam.remote_status import FIRST, RemoteStatus, short_status

SECOND = 1_000_000_000
NOBODY: frozenset[str] = frozenset()


def entries(state: str = "tracking", level: Level = Level.OK, sigma: float = 0.1) -> list[Diagnostic]:
    return [
        Diagnostic(FIRST, Level.OK, state, {"localization.state": state, "sigma_xy_m": f"{sigma}", "paused": "false"}),
        Diagnostic("device/imu", level, "streaming", {"port": "/dev/x"}),
    ]


def test_it_goes_on_change_and_every_ten_seconds_and_not_otherwise():
    status = RemoteStatus()
    sent = [k for k in range(31) if status.due(k * SECOND, entries(sigma=k / 10), NOBODY)]
    assert sent == [0, 10, 20, 30]
    assert status.due(31 * SECOND, entries("lost"), NOBODY)
    assert not status.due(32 * SECOND, entries("lost"), NOBODY)
    assert status.due(33 * SECOND, entries("lost", Level.ERROR), NOBODY)
    assert status.due(34 * SECOND, entries("lost", Level.OK), NOBODY)


def test_who_comes_is_told_at_once():
    status = RemoteStatus()
    assert status.due(0, entries(), NOBODY)
    came = frozenset({"a"})
    assert [status.due(k * SECOND, entries(), came) for k in range(1, 6)] == [True] * 3 + [False] * 2
    assert not status.due(6 * SECOND, entries(), NOBODY), "who leaves needs no telling"


def test_the_worst_comes_first_and_what_is_well_not_at_all():
    content = [
        *entries(),
        Diagnostic("device/screws", Level.WARN, "synchronising", {}),
        Diagnostic("store", Level.ERROR, "not stored: disk full", {"written": "1"}),
    ]
    message = deserialize(short_status(5 * SECOND, content), DIAGNOSTIC_ARRAY)
    assert [entry.name for entry in message.status] == [FIRST, "store", "device/screws"]
    assert {v.key: v.value for v in message.status[0].values}["localization.state"] == "tracking"
    assert message.status[1].message == "not stored: disk full"
    assert message.header.stamp.sec == 5


@given(
    st.lists(
        st.builds(
            Diagnostic,
            st.text(max_size=200),
            st.sampled_from(Level),
            st.text(max_size=300),
            st.dictionaries(st.sampled_from(["paused", "keyframes", "other"]), st.text(max_size=20)),
        ),
        max_size=12,
    )
)
def test_it_is_never_more_than_400_bytes(unwell: list[Diagnostic]):
    payload = short_status(1, [*entries(), *unwell])
    assert len(payload) <= 400
    assert deserialize(payload, DIAGNOSTIC_ARRAY).status[0].name == FIRST
