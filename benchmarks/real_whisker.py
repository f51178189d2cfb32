"""A real magnetic whisker (OpenWhisker): how far it is bent, from its field and the distance of the contact.

    python benchmarks/real_whisker.py [--data FILE.csv] [--plot docs/real-whisker.png]

One group of contact distances is left out of the fit at a time, and predicted. Two models: a lever, and the straight
cubic in field and distance. The data set is not part of this project: give its path with --data, or in the
environment as ROBOMINER_SLAM_DATA (the folder that has hall_real/).

The lever: the tip's end of the shaft is pushed sideways at the distance d from the tip, so at the arm L - d from the
joint. The rod turns by the angle bend / arm, and the shaft itself gives by the force at the contact, which is the
joint's torque over the arm; the field is a smooth function of the angle. So

    bend = e + (L - d) g(y),   g(y) = a u + b u^2,   u = (y - y0) / 10^4 counts

with y the one axis of the sensor that answers the bend. y0 and e take up where the contact begins and how the whisker
leans; `shaft` adds s (L - d)^2 g(y), the shaft's own bend to first order.

Transients: the printer dwells at each bend and some tens of readings are taken in a burst; a label is that of the
last command. Two things in the data say that a reading was taken while the whisker was not where its label says,
without a look at any prediction: (1) a reading lies more than 5 standard deviations from its burst's median, the
printer moved during the burst; (2) a later burst under the same label has its median more than 10 standard deviations
from the first one's, the printer had gone on (0.5 s or more lie between bursts). The standard deviation is the median
over bursts of the scatter within one, by its median absolute deviation.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from calibration.convert import ColumnMap, convert_rows
from robominer_slam.cli.csv_table import read_records

FloatArray = NDArray[np.float64]

FILE = Path("hall_real") / "openwhisker_dev.csv"
BEYOND_NOISE = 5.0
OTHER_PLACE = 10.0
BURST_GAP_S = 0.5
#: A group's distances differ by hundredths of a millimetre.
GROUP_MM = 1.0
SOFT_MM = 0.2


@dataclass(frozen=True)
class Readings:
    """Labelled readings, shape (m,) each: time (s), field (counts), distance and bend (mm)."""

    time: FloatArray
    field: FloatArray
    distance: FloatArray
    bend: FloatArray

    def where(self, mask: NDArray[np.bool_]) -> Readings:
        """Some of the readings."""
        return Readings(self.time[mask], self.field[mask], self.distance[mask], self.bend[mask])


def read(path: Path) -> Readings:
    """The labelled readings; those with distance and bend 0 carry no label."""
    names, records = read_records(path)
    mapping = ColumnMap("time=timestamp,bx=ss.x,by=ss.y,bz=ss.z", wrap=65536.0)
    converted = convert_rows(names, records, mapping, str(path), need_angles=False)
    distance = np.array([float(record["Dist"]) for record in records])
    bend = np.array([float(record["Bend"]) for record in records])
    labelled = distance > 0.0
    readings = Readings(converted.time_s, converted.field_mT[:, 1], distance, bend)
    return readings.where(labelled)


def settled(readings: Readings) -> NDArray[np.bool_]:
    """False for readings taken while the whisker was not where its label says (see above)."""
    relabelled = np.r_[True, (np.diff(readings.distance) != 0) | (np.diff(readings.bend) != 0)]
    label = np.cumsum(relabelled) - 1
    burst = np.cumsum(relabelled | np.r_[True, np.diff(readings.time) > BURST_GAP_S]) - 1
    bursts = [np.flatnonzero(burst == k) for k in range(burst.max() + 1)]
    medians = [float(np.median(readings.field[one])) for one in bursts]
    noise = float(
        np.median([1.4826 * np.median(np.abs(readings.field[o] - c)) for o, c in zip(bursts, medians, strict=True)])
    )
    first: dict[int, float] = {}
    good = np.zeros(len(label), dtype=np.bool_)
    for one, median in zip(bursts, medians, strict=True):
        place = first.setdefault(int(label[one[0]]), median)
        if abs(median - place) <= OTHER_PLACE * noise:
            good[one] = np.abs(readings.field[one] - median) <= BEYOND_NOISE * noise
    return good


def groups(readings: Readings) -> list[float]:
    """Mean distance of each group."""
    ordered = np.sort(readings.distance)
    parts = np.split(ordered, np.flatnonzero(np.diff(ordered) > GROUP_MM) + 1)
    return [float(part.mean()) for part in parts]


def lever(p: FloatArray, field: FloatArray, distance: FloatArray) -> FloatArray:
    u = (field - p[0]) / 1e4
    turn = p[3] * u + p[4] * u**2
    arm = p[1] - distance
    shaft = p[5] * arm**2 * turn / 1e3 if len(p) > 5 else 0.0
    bend: FloatArray = p[2] + arm * turn + shaft
    return bend


def fit_lever(readings: Readings, *, shaft: bool) -> FloatArray:
    start = np.array([35e3, 73.0, 0.0, -0.07, 0.0, 0.0][: 6 if shaft else 5])
    scale = np.array([1e3, 5.0, 1.0, 0.1, 0.1, 0.1][: len(start)])
    found = least_squares(
        lambda p: lever(p, readings.field, readings.distance) - readings.bend,
        start, loss="soft_l1", f_scale=SOFT_MM, x_scale=scale,
    )  # fmt: skip
    return np.asarray(found.x)


def cubic_features(field: FloatArray, distance: FloatArray) -> FloatArray:
    """All monomials up to the third degree."""
    u, v = field / 2e4, distance / 20.0
    return np.stack([u**i * v**j for i in range(4) for j in range(4 - i)], axis=-1)


def predict(train: Readings, test: Readings) -> dict[str, FloatArray]:
    """Bend of the readings that were left out, by model."""
    result = {
        "lever": lever(fit_lever(train, shaft=False), test.field, test.distance),
        "lever, shaft": lever(fit_lever(train, shaft=True), test.field, test.distance),
    }
    features, held = cubic_features(train.field, train.distance), cubic_features(test.field, test.distance)
    for name, cutoff in (("cubic", None), ("cubic, cut", 1e-3)):
        # Three distances do not determine a cubic in the distance; the cut leaves out what they do not say.
        result[name] = held @ np.linalg.lstsq(features, train.bend, rcond=cutoff)[0]
    return result


def errors(readings: Readings) -> dict[str, dict[float, tuple[float, float, FloatArray]]]:
    """By model and group: RMS and median error as shares of the bend's range, and the predicted bends."""
    span = float(np.ptp(readings.bend))
    result: dict[str, dict[float, tuple[float, float, FloatArray]]] = {}
    for centre in groups(readings):
        inside = np.abs(readings.distance - centre) < GROUP_MM
        test = readings.where(inside)
        for name, bend in predict(readings.where(~inside), test).items():
            error = np.abs(bend - test.bend)
            rms, median = float(np.sqrt(np.mean(error**2))) / span, float(np.median(error)) / span
            result.setdefault(name, {})[centre] = rms, median, bend
    return result


def default_data() -> Path:
    folder = os.environ.get("ROBOMINER_SLAM_DATA")
    return (Path(folder) if folder else Path(__file__).resolve().parents[2] / "shared" / "data") / FILE


def plot(readings: Readings, out: Path) -> None:
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    found = errors(readings)
    centres = groups(readings)
    figure, axes = plt.subplots(1, len(centres), figsize=(12.0, 3.4), sharey=True, layout="constrained")
    for k, (ax, centre) in enumerate(zip(axes, centres, strict=True)):
        inside = np.abs(readings.distance - centre) < GROUP_MM
        true = readings.bend[inside]
        ax.plot([1.5, 11.0], [1.5, 11.0], color="0.7", lw=1.0)
        for name, colour, shift in (("lever", "C0", -0.08), ("lever, shaft", "C1", 0.08)):
            rms, _, bend = found[name][centre]
            ax.plot(true + shift, bend, ".", color=colour, ms=3.0, label=f"{name}: {100 * rms:.1f} %")
        ax.set_title(f"contact {centre:.1f} mm from the tip" if k == 0 else f"{centre:.1f} mm", fontsize=10)
        ax.set_xlabel("true bend, mm")
        ax.legend(fontsize=8, loc="upper left")
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("predicted bend, mm")
    figure.suptitle("Bend of a real whisker at distances left out of the fit (RMS as a share of the bend's range)",
                    fontsize=11)  # fmt: skip
    figure.savefig(out, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=default_data())
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    if not arguments.data.is_file():
        parser.error(f"{arguments.data}: not there; give the data set's path with --data")
    readings = read(arguments.data)
    good = settled(readings)
    console = Console()
    console.print(f"{len(good)} labelled readings, {np.count_nonzero(~good)} of them transients")
    for title, chosen in (("all readings", readings), ("without transients", readings.where(good))):
        found = errors(chosen)
        table = Table(title=f"{title}: error at distances left out, % of the bend's range, RMS (median)")
        table.add_column("model")
        for centre in groups(chosen):
            table.add_column(f"{centre:.1f} mm", justify="right")
        for name, by_group in found.items():
            table.add_row(name, *(f"{100 * rms:.1f} ({100 * median:.1f})" for rms, median, _ in by_group.values()))
        console.print(table)
    if arguments.plot is not None:
        plot(readings.where(good), arguments.plot)
        console.print(f"wrote {arguments.plot}")


if __name__ == "__main__":
    main()
