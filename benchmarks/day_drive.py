"""A day of driving in minutes: the daemon's own loop, store and bus, fed as fast as it takes; what grows, and what not.

    python -m benchmarks.day_drive --hours 24 --out out/day

A simulated robot (quasi-static, all sensors of the array, IMU, screws) drives the thesis's scenario 5 there and back,
with three different noises, again and again: the robot is where it began after each lap, and the measurements' clock
goes on. The daemon computes in the same process and publishes to a Zenoh session that nobody hears. Sampled every ten
minutes of its time: memory, open files, threads, bytes on the disk, keyframes, and the error of the pose.

Time is the measurements': what the daemon does by the clock happens as often as it would. The back-end computes in the
main thread, as replay does. Writes day.csv and day.png, prints a table.
"""

from __future__ import annotations

import csv
import gc
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path

import click
import numpy as np

from benchmarks.random_drives import measurements, simulated_robot
from drivers.device import DeviceStatus
from drivers.measurement import HallFrame, Measurement, ScrewAngles
from robominer_slam import daemon
from robominer_slam.calibrated_array import CalibratedArray
from robominer_slam.configuration.reload import Reload
from robominer_slam.frame_result import FrameResult
from robominer_slam.heap import give_large_blocks_back
from robominer_slam.notify import Notifier
from robominer_slam.publishing.robot_settings import robot_settings
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.replay import prepare
from robominer_slam.service import keep_what_is_there
from robominer_slam.store import MapStore
from robominer_slam.supervision import Supervision
from sim_backend import world as worlds
from sim_backend.events import TruthEvent

ROOT = Path(__file__).resolve().parents[1]
#: Its configuration and calibration are the robot's.
RECORDING = ROOT / "tests" / "recordings" / "scenario-5.mcap"
SEEDS = (1, 2, 3)
SAMPLE_S = 600.0


@dataclass(frozen=True)
class Sample:
    """The process at a time."""

    hours: float
    memory_MB: float
    files: int
    threads: int
    disk_MB: float
    keyframes: int
    closures: int
    error_mean_m: float
    error_worst_m: float
    cpu_s: float


@dataclass
class Lap:
    """Measurements from a start back to it, times from 0 (ns), and the truth (time in s, x, y)."""

    items: list[tuple[str, Measurement]]
    truth: np.ndarray
    length_ns: int
    turned: np.ndarray


def drive_lap(seed: int) -> Lap:
    """There and back; the last waypoint is the first."""
    there = np.asarray(worlds.load("thesis").scenarios[5])
    robot = simulated_robot("thesis", np.concatenate([there, there[-2::-1]]), seed)
    items: list[tuple[str, Measurement]] = []
    truth = []
    first = None
    turned = np.zeros(4)
    for event in measurements(robot):
        stamp = event.time_ns if isinstance(event, TruthEvent) else event[1].stamp_ns
        first = stamp if first is None else first
        if isinstance(event, TruthEvent):
            truth.append(((stamp - first) * 1e-9, event.position[0], event.position[1]))
            continue
        device, measurement = event
        if device == "odometry":
            continue
        if isinstance(measurement, HallFrame):
            measurement = replace(measurement, field_mT=measurement.field_mT.astype(np.float32))
        if isinstance(measurement, ScrewAngles):
            turned = measurement.angle
        items.append((device, replace(measurement, stamp_ns=stamp - first)))
    last = max(one.stamp_ns for _, one in items)
    return Lap(items, np.array(truth), last + 20_000_000, turned)


class EndlessDrive:
    """A source of measurements: lap after lap."""

    dropped = 0

    def __init__(self, laps: list[Lap], hours: float, stop: threading.Event) -> None:
        self.now_ns = 1_000_000_000
        self.lap, self.begun_ns = laps[0], self.now_ns
        self._laps, self._stop = laps, stop
        self._end_ns = self.now_ns + round(hours * 3600e9)
        self._items = self._measurements()

    def __enter__(self) -> EndlessDrive:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def status(self) -> list[DeviceStatus]:
        """All is well."""
        return [DeviceStatus(name, "streaming", None, "", {}, 0, 0, 0.0, "") for name in ("whiskers", "imu", "screws")]

    def get(self, _: float) -> tuple[str, Measurement] | None:
        """The next measurement; at the end none, and the daemon is told to stop."""
        item = next(self._items, None)
        if item is None:
            self._stop.set()
        return item

    def _measurements(self) -> Iterator[tuple[str, Measurement]]:
        turned, number = np.zeros(4), 0
        while True:
            self.lap, self.begun_ns = self._laps[number % len(self._laps)], self.now_ns
            for device, measurement in self.lap.items:
                stamp = self.begun_ns + measurement.stamp_ns
                self.now_ns = max(self.now_ns, stamp)
                if self.now_ns > self._end_ns:
                    return
                if isinstance(measurement, ScrewAngles):
                    yield device, ScrewAngles(stamp, measurement.angle + turned)
                elif isinstance(measurement, HallFrame):
                    field = measurement.field_mT.astype(np.float64)
                    yield device, replace(measurement, stamp_ns=stamp, field_mT=field)
                else:
                    yield device, replace(measurement, stamp_ns=stamp)
            turned = turned + self.lap.turned
            self.now_ns = self.begun_ns + self.lap.length_ns
            number += 1


class Watch:
    """Samples between frames."""

    def __init__(self, source: EndlessDrive, folder: Path, out: Path) -> None:
        self._source, self._folder, self._out = source, folder, out
        self.samples: list[Sample] = []
        self._next_ns = source.now_ns + round(SAMPLE_S * 1e9)
        self._errors: list[float] = []
        self._begin_ns = source.now_ns

    def frame(self, running: daemon.Daemon, result: FrameResult) -> None:
        """A frame has been published."""
        lap = self._source.lap
        at = (result.stamp_ns - self._source.begun_ns) * 1e-9
        # The map begins at the robot's first pose; laps begin there, too.
        x, y = (np.interp(at, lap.truth[:, 0], lap.truth[:, k]) - lap.truth[0, k] for k in (1, 2))
        c, s = self._heading
        place = result.T_map_base[:2, 3]
        self._errors.append(float(np.hypot(*(place - [c * x + s * y, c * y - s * x]))))
        if self._source.now_ns >= self._next_ns:
            self._next_ns += round(SAMPLE_S * 1e9)
            self._sample(running)

    _heading = (1.0, 0.0)

    def set_heading(self, heading: float) -> None:
        """Of the robot in the world where the map begins."""
        self._heading = float(np.cos(heading)), float(np.sin(heading))

    def _sample(self, running: daemon.Daemon) -> None:
        gc.collect()
        status = Path("/proc/self/status").read_text().splitlines()
        memory = next(float(line.split()[1]) / 1e3 for line in status if line.startswith("VmRSS"))
        disk = sum(path.stat().st_size for path in self._folder.rglob("*") if path.is_file()) / 1e6
        errors = np.array(self._errors)
        self._errors.clear()
        sample = Sample(
            (self._source.now_ns - self._begin_ns) / 3600e9, memory, _entries("fd"),
            _entries("task"), disk, len(running._map.keyframes), running._map.closures,
            float(errors.mean()), float(errors.max()), time.process_time(),
        )  # fmt: skip
        self.samples.append(sample)
        with (self._out / "day.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(field.name for field in fields(Sample))
            writer.writerows([getattr(one, field.name) for field in fields(Sample)] for one in self.samples)


class WatchedDaemon(daemon.Daemon):
    """Tells the watch of each frame."""

    watch: Watch

    def _frame(self, result: FrameResult) -> None:
        super()._frame(result)
        self.watch.frame(self, result)


def plot(samples: list[Sample], path: Path) -> None:
    """Memory, disk, files and threads, and the error over the hours."""
    from matplotlib.figure import Figure

    hours = [one.hours for one in samples]
    figure = Figure(figsize=(8.0, 8.0), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    axes[0].plot(hours, [one.memory_MB for one in samples], color="#0072b2")
    axes[0].set_ylabel("memory (MB)")
    axes[1].plot(hours, [one.disk_MB for one in samples], color="#0072b2")
    axes[1].set_ylabel("on the disk (MB)")
    axes[2].plot(hours, [one.files for one in samples], color="#0072b2", label="open files")
    axes[2].plot(hours, [one.threads for one in samples], color="#d55e00", linestyle="--", label="threads")
    axes[2].set_ylabel("number")
    axes[2].legend()
    axes[3].plot(hours, [100.0 * one.error_mean_m for one in samples], color="#0072b2", label="mean of ten minutes")
    axes[3].plot(hours, [100.0 * one.error_worst_m for one in samples], color="#d55e00", linestyle="--", label="worst")
    axes[3].set_ylabel("error of the pose (cm)")
    axes[3].legend()
    axes[3].set_xlabel("time of the robot (h)")
    for axis in axes:
        axis.set_ylim(bottom=0.0)
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def table(samples: list[Sample]) -> str:
    """Some rows, evenly."""
    rows = [
        "| hours | memory (MB) | files | threads | disk (MB) | keyframes | error, mean / worst (m) |",
        "|" + "---|" * 7,
    ]
    for k in np.unique(np.linspace(0, len(samples) - 1, 13).astype(int)):
        one = samples[k]
        rows.append(
            f"| {one.hours:.1f} | {one.memory_MB:.1f} | {one.files} | {one.threads} | {one.disk_MB:.2f} "
            f"| {one.keyframes} | {one.error_mean_m:.3f} / {one.error_worst_m:.3f} |"
        )
    return "\n".join(rows)


@click.command()
@click.option("--hours", default=24.0, show_default=True, help="Of driving.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("out/day"), show_default=True)
def main(hours: float, out: Path) -> None:
    """Drive, watch, plot."""
    out.mkdir(parents=True, exist_ok=True)
    inputs = prepare(RECORDING, None)
    laps = [drive_lap(seed) for seed in SEEDS]
    click.echo(f"three laps of {laps[0].length_ns * 1e-9:.0f} s are simulated")
    folder = out / "store"
    folder.mkdir(exist_ok=True)
    for old in folder.glob("map.db*"):
        old.unlink()
    stop = threading.Event()
    source = EndlessDrive(laps, hours, stop)
    watch = Watch(source, folder, out)
    watch.set_heading(float(np.asarray(worlds.load("thesis").scenarios[5])[0][2]))
    configuration = inputs.configuration
    prefix = f"robominer/{configuration.robot.id}"
    store = MapStore(folder / "map.db", configuration.store.sync_s, configuration.robot.id, "")
    supervision = Supervision(Notifier(), Reload(RECORDING, configuration))
    with ZenohBus(robot_settings(configuration.zenoh, folder, prefix), prefix) as bus, store:
        array = CalibratedArray(inputs.layout, inputs.model)
        running = WatchedDaemon(
            configuration,
            array,
            source,
            bus,
            store,
            supervision,
            monotonic_ns=lambda: source.now_ns,
            execution="synchronous",
        )
        running.watch = watch
        keep_what_is_there()
        give_large_blocks_back()
        running.run(stop)
    plot(watch.samples, out / "day.png")
    text = table(watch.samples)
    (out / "table.md").write_text(text + "\n")
    click.echo(text)


def _entries(name: str) -> int:
    return sum(1 for _ in Path("/proc/self", name).iterdir())


if __name__ == "__main__":
    main()
