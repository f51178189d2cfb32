"""Broken whiskers in a recorded drive: found within a second, left out, back again; healthy ones never accused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration.angle_estimator import AngleEstimator
from drivers.measurement import HallFrame
from robominer_slam.configuration.model import ContactSection, HealthSection
from robominer_slam.flow_bend import FlowBend
from robominer_slam.layout import thesis_grid
from robominer_slam.replay import prepare, replay
from robominer_slam.whisker_health import WhiskerHealth, WhiskerState
from sim_backend.events import WhiskerEvent
from sim_backend.fault_schedule import Fault
from sim_backend.robot import RobotSettings
from sim_backend.sensor_faults import SensorFaults
from sim_backend.simulate import SimulationSettings, record_drive

RECORDING = Path(__file__).parent / "recordings" / "scenario-1.mcap"
FRAMES = 500
START, END = 8.0, 14.0
WHISKER = (3, 4)
INDEX = 3 * 8 + 4


@pytest.fixture(scope="module")
def drive():
    """The first 20 s of scenario 1: model, frames, and the true positions at their times."""
    inputs = prepare(RECORDING, None)
    frames = []
    for _, measurement in inputs.recording:
        if isinstance(measurement, HallFrame):
            frames.append(measurement)
            if len(frames) == FRAMES:
                break
    truth = [t for _, t in inputs.recording.ground_truth()]
    stamps, poses = [t.stamp_ns for t in truth], np.array([t.pose[:2] for t in truth])
    when = [f.stamp_ns for f in frames]
    positions = np.column_stack([np.interp(when, stamps, poses[:, i]) for i in (0, 1)])
    return inputs.model, frames, positions


def states_of(drive, *faults, seed=0, change=None):
    """States after each frame, shape (frames, n)."""
    model, frames, positions = drive
    first = frames[0].stamp_ns
    events = (
        WhiskerEvent(f.stamp_ns - first, f.stamp_ns, f.field_mT.reshape(-1, 3), f.valid.reshape(-1), None)
        for f in frames
    )
    estimator = AngleEstimator(model)
    health = WhiskerHealth(HealthSection(), thesis_grid(), model.rest_mT, model.fitted, folded=False)
    states = []
    for k, event in enumerate(SensorFaults(faults, model.rest_mT, cols=8, seed=seed).apply(events)):
        field = event.field_mT if change is None else change(k / 25.0, event.field_mT.copy())
        angles = estimator.angles(field, event.valid)
        health.update(event.time_ns, field, event.valid, angles.inclination, angles.azimuth, tuple(positions[k]))
        states.append(health.state.copy())
    return np.array(states)


FOUND = {
    "whisker_dead": WhiskerState.DEAD,
    "whisker_stuck": WhiskerState.STUCK,
    "whisker_noisy": WhiskerState.NOISY,
    "whisker_flipped": WhiskerState.FLIPPED,
    "whisker_broken": WhiskerState.BROKEN,
    "whisker_bus_error": WhiskerState.SILENT,
}


@pytest.mark.parametrize("kind", FOUND)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_fault_is_found_within_a_second_and_forgotten_after_it_ends(drive, kind, seed):
    states = states_of(drive, Fault(kind, START, END, WHISKER), seed=seed)
    own = states[:, INDEX]
    assert not np.delete(states, INDEX, axis=1).any()
    assert not own[: round(START * 25)].any()
    found = np.flatnonzero(own)[0] / 25.0 - START
    assert found <= 1.0
    assert (own[round((START + 1.0) * 25) : round(END * 25)] == FOUND[kind]).all()
    # Well again between one and two and a half seconds after the end.
    assert own[round((END + 1.0) * 25)] != 0
    assert not own[round((END + 2.6) * 25) :].any()


def test_a_lost_magnet_is_broken_and_a_sensor_at_its_end_saturated(drive):
    states = states_of(drive, Fault("whisker_broken", START, END, WHISKER, {"magnet": "lost"}))
    assert (states[round((START + 1.0) * 25) : round(END * 25), INDEX] == WhiskerState.BROKEN).all()

    def at_end(time, field):
        if START <= time < END:
            field[INDEX, 2] = 130.0 - 0.1 * (round(time * 25) % 2)
        return field

    states = states_of(drive, change=at_end)
    assert (states[round((START + 1.0) * 25) : round(END * 25), INDEX] == WhiskerState.SATURATED).all()


def test_one_reversed_axis_shows_as_a_rod_that_bends_against_all_others(drive):
    states = states_of(drive, Fault("whisker_flipped", 2.0, 20.0, WHISKER, {"axes": "x"}))
    assert states[-1, INDEX] == WhiskerState.FLIPPED
    assert not np.delete(states, INDEX, axis=1).any()


def test_several_at_once_are_told_apart(drive):
    faults = [Fault(kind, START, END, (row, 2)) for row, kind in enumerate(FOUND)]
    states = states_of(drive, *faults)
    at = round((START + 1.2) * 25)
    assert [int(states[at, row * 8 + 2]) for row in range(len(FOUND))] == [int(s) for s in FOUND.values()]
    assert np.count_nonzero(states[at]) == len(FOUND)


def test_a_healthy_drive_accuses_nobody(drive):
    assert not states_of(drive).any()


def test_a_frozen_array_is_stuck_as_a_whole(drive):
    frozen = []

    def freeze(time, field):
        frozen.append(field)
        return frozen[100] if time > 4.0 else field

    states = states_of(drive, change=freeze)
    assert (states[150] == WhiskerState.STUCK).all()


@pytest.fixture(scope="module")
def flooded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flooded")
    settings = SimulationSettings(folder, world="flooded", engine="quasi-static", robot=RobotSettings(max_time=40.0))
    record_drive(settings, folder / "drive.mcap")
    return folder / "drive.mcap"


def test_free_rods_in_flowing_water_are_told_from_contacts(flooded):
    inputs = prepare(flooded, None)
    truth = np.array([t.contact for _, t in inputs.recording.whisker_truth()])
    said, kept = np.zeros_like(truth), np.zeros_like(truth)
    number = iter(range(len(truth)))

    def take(result):
        k = next(number)
        said[k] = result.angles.valid & (result.angles.inclination >= np.deg2rad(4.0))
        kept[k, result.contacts.index] = True

    replay(inputs, take)
    said &= kept | (said & ~kept)
    before = (said & ~truth).sum() / said.sum()
    after = (kept & ~truth).sum() / kept.sum()
    lost = (said & ~kept & truth).sum() / (said & truth).sum()
    assert before > 0.05
    assert after < before / 4
    assert lost < 0.02


def bends(flow, inclination, azimuth, velocity=(0.15, 0.0, 0.0), stamp=0):
    return flow.free(stamp, inclination, azimuth, np.ones(64, bool), 0.0, np.array(velocity))


def test_tips_that_all_trail_on_level_ground_are_contacts():
    flow = FlowBend(ContactSection(), thesis_grid())
    level = np.full(64, np.deg2rad(6.0))
    assert bends(flow, level, np.full(64, np.pi)) is None
    free = bends(flow, level, np.full(64, 1.0))
    assert free is not None
    assert free.all()
