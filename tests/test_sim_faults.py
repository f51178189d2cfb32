"""What goes wrong on purpose: sensors, lines, clocks and their schedule."""

from __future__ import annotations

import contextlib
import math
import os
import select
import termios
import tty

import numpy as np
import pytest

from sim_backend.events import EncoderEvent, ImuEvent, TruthEvent, WhiskerEvent
from sim_backend.fault_schedule import (
    KINDS,
    Fault,
    FaultFileError,
    faults_from_option,
    load_faults,
    random_faults,
)
from sim_backend.line_faults import FaultyClock, FaultyLine, damaged
from sim_backend.pseudo_terminal import PseudoTerminal
from sim_backend.sensor_faults import SensorFaults, bent

MS = 1_000_000
SECOND = 1000 * MS
ARRAY = (2, 2, 600)
REST = np.tile([0.0, 0.0, 9.8], (4, 1))


def frames(seconds=4, rate=25):
    """A 2 x 2 array whose every reading differs from the last."""
    for k in range(seconds * rate):
        t = k * SECOND // rate
        yield WhiskerEvent(t, t, REST + 0.098 * (k + 1), np.ones(4, bool), None)


def readings(*faults, sensor=1, seconds=4):
    """Readings of one sensor during the third second, healthy and with the faults; and the other sensors' events."""
    sick = SensorFaults(faults, REST, cols=2).apply(frames(seconds))
    pairs = [(h, s) for h, s in zip(frames(seconds), sick, strict=True) if 2 * SECOND <= h.time_ns < 3 * SECOND]
    assert all((np.delete(h.field_mT, sensor, 0) == np.delete(s.field_mT, sensor, 0)).all() for h, s in pairs)
    return np.array([h.field_mT[sensor] for h, _ in pairs]), np.array([s.field_mT[sensor] for _, s in pairs])


def whisker(kind, **parameters):
    return Fault(kind, 2.0, 3.0, (0, 1), parameters)


def test_a_dead_whisker_is_all_zeros():
    assert not readings(whisker("whisker_dead"))[1].any()


def test_a_stuck_whisker_keeps_its_first_value():
    healthy, sick = readings(whisker("whisker_stuck"))
    assert (sick == healthy[0]).all()


def test_a_noisy_whisker_has_the_stated_noise_in_steps_of_the_sensor():
    healthy, sick = readings(whisker("whisker_noisy", sigma_mT=2.0))
    assert (sick - healthy).std() == pytest.approx(2.0, rel=0.3)
    steps = sick / 0.098
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)


def test_a_flipped_whisker_has_the_stated_axes_reversed():
    healthy, sick = readings(whisker("whisker_flipped"))
    np.testing.assert_array_equal(sick, -healthy)
    healthy, sick = readings(whisker("whisker_flipped", axes="xz"))
    np.testing.assert_array_equal(sick, healthy * [-1, 1, -1])


def test_a_broken_whisker_shows_rest_whatever_it_touches_or_nothing_without_its_magnet():
    _, sick = readings(whisker("whisker_broken"))
    assert np.abs(sick - REST[1]).max() < 6 * 0.12
    _, sick = readings(whisker("whisker_broken", magnet="lost"))
    assert np.abs(sick).max() < 6 * 0.12
    assert sick.any()


def test_a_bent_whisker_is_turned_by_the_stated_angle():
    np.testing.assert_allclose(bent(np.array([0.0, 0.0, 2.0]), 30.0, 90.0), [0.0, 1.0, np.sqrt(3.0)], atol=1e-12)
    healthy, sick = readings(whisker("whisker_bent", tilt_deg=10.0))
    cosine = (healthy * sick).sum(1) / np.linalg.norm(healthy, axis=1) / np.linalg.norm(sick, axis=1)
    assert np.degrees(np.arccos(cosine)).mean() == pytest.approx(9.0, abs=1.5)


def test_a_bus_error_is_marked_and_a_fault_ends_when_it_should():
    sick = list(SensorFaults([whisker("whisker_bus_error")], REST, cols=2).apply(frames()))
    for healthy, frame in zip(frames(), sick, strict=True):
        assert frame.valid.tolist() == [True, not 2 * SECOND <= frame.time_ns < 3 * SECOND, True, True]
        np.testing.assert_array_equal(frame.field_mT, healthy.field_mT)


def test_a_fault_of_a_whisker_outside_the_array_is_refused():
    with pytest.raises(ValueError, match="row 2, column 0: the array is 2 x 2"):
        SensorFaults([Fault("whisker_dead", 0.0, target=(2, 0))], REST, cols=2)
    with pytest.raises(ValueError, match="the array is 2 x 2"):
        SensorFaults([Fault("whisker_dead", 0.0, target=(0, 2))], REST, cols=2)


def turns(speed, seconds=4):
    for k in range(seconds * 50):
        angle = np.full(4, speed * 0.02 * k)
        yield EncoderEvent(20 * MS * k, 20 * MS * k, np.floor(angle * 4096 / (2 * np.pi)).astype(np.int64), angle)


def test_one_screw_slips_only_while_the_screws_turn_and_its_count_stays_continuous():
    fault = Fault("screw_slip", 1.0, 2.0, "rear_left", {"extra_rad_s": 6.0})
    sick = list(SensorFaults([fault], REST, cols=2).apply(turns(2.0)))
    extra = np.array([s.ticks - h.ticks for s, h in zip(sick, turns(2.0), strict=True)]) * 2 * np.pi / 4096
    assert not extra[:, [0, 1, 3]].any()
    assert not extra[:50].any()
    np.testing.assert_allclose(extra[100:, 2], 6.0, atol=0.01)
    assert np.abs(np.diff(extra[:, 2])).max() < 6.0 * 0.02 + 0.005
    np.testing.assert_allclose([s.angle for s in sick], extra + [h.angle for h in turns(2.0)], atol=1e-9)
    standing = SensorFaults([fault], REST, cols=2).apply(turns(0.0))
    assert not any(event.ticks.any() for event in standing)


def test_a_silent_imu_sends_nothing_and_the_truth_is_never_touched():
    up = np.array([0.0, 0.0, 9.81])
    truth = TruthEvent(SECOND, SECOND, up, np.array([0.0, 0.0, 0.0, 1.0]), up, up)
    events = [ImuEvent(t, t, up, up, up) for t in (0, SECOND, 2 * SECOND)]
    left = list(SensorFaults([Fault("imu_silent", 0.5, 1.5)], REST, cols=2).apply([*events, truth]))
    assert left == [events[0], events[2], truth]


def test_damage_loses_flips_and_doubles_bytes_at_the_stated_rates():
    data = bytes(range(256)) * 400
    rng = np.random.default_rng(1)
    assert damaged(data, rng, lost=0.0, flipped=0.0, duplicated=0.0) == data
    assert len(damaged(data, rng, lost=0.01, flipped=0.0, duplicated=0.0)) == pytest.approx(0.99 * len(data), rel=2e-3)
    assert len(damaged(data, rng, lost=0.0, flipped=0.0, duplicated=0.01)) == pytest.approx(1.01 * len(data), rel=2e-3)
    flipped = np.frombuffer(damaged(data, rng, lost=0.0, flipped=0.01, duplicated=0.0), np.uint8)
    difference = flipped ^ np.frombuffer(data, np.uint8)
    assert (difference > 0).mean() == pytest.approx(0.01, rel=0.15)
    assert {int(d).bit_count() for d in difference} == {0, 1}


class Host:
    def __init__(self, path):
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self.fd, termios.TCSANOW)

    def read(self):
        try:
            return os.read(self.fd, 65536)
        except BlockingIOError:
            return b""

    def read_some(self):
        """What comes first, within two seconds."""
        assert select.select([self.fd], [], [], 2.0)[0]
        return self.read()


class Recorder:
    """A port that keeps what it is given."""

    def __init__(self, path):
        self.path, self.written, self.dropped, self.plugged = path, b"", 0, True

    def write(self, packet):
        self.written += packet
        return True

    def unread(self):
        return 0

    def close(self):
        self.plugged = False

    def read(self):
        written, self.written = self.written, b""
        return written


@contextlib.contextmanager
def line_of(folder, *faults, open_port=PseudoTerminal):
    line = FaultyLine(folder / "one", faults, np.random.default_rng(0), open_port)
    try:
        yield line
    finally:
        line.close()


def test_a_stall_holds_packets_back_and_delivers_them_in_one_burst(tmp_path):
    ports = []
    with line_of(tmp_path, Fault("stall", 1.0, 1.6), open_port=lambda p: ports.append(Recorder(p)) or ports[0]) as line:
        heard = []
        for k in range(20):
            line.advance(0.1 * k)
            line.write(bytes([k]))
            heard.append(ports[0].read())
        assert heard[9] == b"\x09"
        assert heard[10:16] == [b""] * 6
        assert heard[16] == bytes(range(10, 17))
        assert heard[17] == b"\x11"
        assert line.dropped == 0


def test_a_stall_holds_no_more_than_its_buffer(tmp_path):
    with line_of(tmp_path, Fault("stall", 0.0, 1e9)) as line:
        line.advance(1.0)
        assert sum(line.write(bytes(1 << 16)) for _ in range(40)) == 16
        assert line.dropped == 24
        assert line.unread() == 1 << 20


@pytest.mark.parametrize("name", ["", "other"])
def test_an_unplugged_device_vanishes_and_comes_back_under_the_stated_name(tmp_path, name):
    with line_of(tmp_path, Fault("unplugged", 1.0, 2.0, "one", {"name": name})) as line:
        host = Host(tmp_path / "one")
        assert not line.advance(0.5)
        assert not line.advance(1.5)
        assert not line.plugged
        assert not any(tmp_path.iterdir())
        with pytest.raises(OSError, match="Input/output error"):
            os.write(host.fd, b"?")
        assert not line.write(b"lost")
        assert (line.read(), line.unread(), line.dropped) == (b"", 0, 1)
        assert line.advance(2.0)
        assert [path.name for path in tmp_path.iterdir()] == [name or "one"]
        again = Host(line.path)
        assert line.write(b"back")
        assert again.read_some() == b"back"
        assert line.unplugged == 1


def test_a_good_line_passes_everything_unharmed(tmp_path):
    port = Recorder(tmp_path / "one")
    with line_of(tmp_path, Fault("bytes_flipped", 5.0, 6.0, "one", {"rate": 1.0}), open_port=lambda _: port) as line:
        line.write(b"before")
        line.advance(5.5)
        line.write(b"during")
        line.advance(6.0)
        line.write(b"after")
        heard = port.read()
        assert heard.startswith(b"before")
        assert heard.endswith(b"after")
        assert len(heard) == 17
        assert b"during" not in heard
        assert line.damaged == 1


def test_a_clock_drifts_jumps_and_wraps_as_scheduled():
    faults = [
        Fault("clock_drift", 10.0, 20.0, "one", {"ppm": 100.0}),
        Fault("clock_jump", 30.0, math.inf, "one", {"seconds": -2.0}),
    ]
    clock = FaultyClock(1000, 0.0, 0, faults)
    clock.begin(5 * SECOND, 1.0)
    healthy = [1000 + 1_000_000 * t for t in (14, 20, 25, 34, 36)]
    shown = [clock.microseconds(t * SECOND) for t in (14, 20, 25, 34, 36)]
    assert np.subtract(shown, healthy).tolist() == [0, 500, 1000, 1000, 1000 - 2_000_000]
    wrapping = FaultyClock(0, 0.0, 0, [Fault("clock_wrap", 3.0)])
    assert wrapping.microseconds(3 * SECOND) == 1 << 32
    clock.restart(40 * SECOND)
    assert clock.microseconds(41 * SECOND) == 1_000_000


def test_a_file_gives_its_faults_in_order_of_time(tmp_path):
    path = tmp_path / "faults.toml"
    path.write_text(
        """
        [[fault]]
        kind = "stall"
        device = "imu"
        start = 30
        [[fault]]
        kind = "whisker_noisy"
        row = 3
        col = 5
        sigma_mT = 1.5
        start = 10.0
        end = 20.0
        [[fault]]
        kind = "screw_slip"
        screw = "rear_right"
        """
    )
    slip, noisy, stall = load_faults(path).faults
    assert slip == Fault("screw_slip", 0.0, math.inf, "rear_right", {"extra_rad_s": 6.0})
    assert noisy == Fault("whisker_noisy", 10.0, 20.0, (3, 5), {"sigma_mT": 1.5})
    assert (stall.kind, stall.target, stall.start, stall.end) == ("stall", "imu", 30.0, 30.6)
    schedule = load_faults(path)
    assert schedule.of_sensors() == (slip, noisy)
    assert schedule.of_device("imu") == (stall,)
    assert schedule.of_device("whiskers") == ()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[[fault]\n", "not a TOML file"),
        ("seed = 3\n", "expected only [[fault]] tables, found 'seed'"),
        ("fault = 3\n", "expected only [[fault]] tables"),
        ("fault = [3]\n", "fault 1: expected a table"),
        ("[[fault]]\nkind = 'flood'\n", "fault 1: kind is 'flood', expected one of whisker_dead"),
        ("[[fault]]\nkind = ['flood']\n", "fault 1: kind is ['flood'], expected one of"),
        (
            "[[fault]]\nkind = 'whisker_dead'\nrow = 1\n",
            "fault 1 (whisker_dead): col is None, expected a whole number",
        ),
        ("[[fault]]\nkind = 'stall'\n", "device is None, expected a device's name"),
        ("[[fault]]\nkind = 'screw_slip'\nscrew = 'left'\n", "screw is 'left', expected one of front_right"),
        ("[[fault]]\nkind = 'imu_silent'\nstart = -1\n", "start is -1, expected a number from 0 to inf"),
        ("[[fault]]\nkind = 'imu_silent'\nstart = nan\n", "start is nan, expected a number"),
        ("[[fault]]\nkind = 'imu_silent'\nstart = 5\nend = 4\n", "end is 4, expected a number from 5 to inf"),
        ("[[fault]]\nkind = 'imu_silent'\nrow = 4\n", "unknown key 'row'; its parameters: none"),
        (
            "[[fault]]\nkind = 'bytes_lost'\ndevice = 'imu'\nrate = 2\n",
            "rate is 2, expected a number from 0 to 1",
        ),
        ("[[fault]]\nkind = 'whisker_flipped'\nrow=1\ncol=1\naxes = 'q'\n", "axes is 'q', expected some of"),
        ("[[fault]]\nkind = 'unplugged'\ndevice = 'imu'\nname = '../x'\n", "expected a name without '/'"),
    ],
)
def test_a_bad_file_gets_one_clear_line(tmp_path, text, expected):
    path = tmp_path / "faults.toml"
    path.write_text(text)
    with pytest.raises(FaultFileError) as error:
        load_faults(path)
    assert expected in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_a_missing_file_or_a_bad_seed_is_told(tmp_path):
    with pytest.raises(FaultFileError, match="cannot read the faults: No such file"):
        faults_from_option(str(tmp_path / "none.toml"), 60.0)
    with pytest.raises(FaultFileError, match="expected a file or seed:N"):
        faults_from_option("seed:x", 60.0)


def test_a_seed_draws_the_same_faults_again_and_every_kind_sooner_or_later():
    assert random_faults(3, 100.0) == random_faults(3, 100.0) == faults_from_option("seed:3", 100.0)
    assert random_faults(3, 100.0) != random_faults(4, 100.0)
    drawn = [fault for seed in range(30) for fault in random_faults(seed, 100.0, rows=10, cols=4).faults]
    assert {fault.kind for fault in drawn} == set(KINDS)
    assert all(0.0 <= fault.start <= 90.0 and fault.start < fault.end for fault in drawn)
    rows, cols = np.array([fault.target for fault in drawn if isinstance(fault.target, tuple)]).T
    assert (rows.max(), cols.max()) == (9, 3)
