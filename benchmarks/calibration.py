"""Accuracy of the calibration on simulated arrays with full tolerances, and what it costs (docs/calibration.md).

Usage: python -m benchmarks.calibration [--seeds N] [--frames N] [--json]

Test poses: all rods anywhere in the hemisphere up to 70 deg (uniform over it), each neighbour elsewhere, the robot
headed anywhere; noise and the 0.098 mT steps of the sensor included. Printed:

- jig, ring plates, floor: angle between true and estimated rod direction, the tip's error, share within 2 sigma,
  by the chosen model, each model alone, and without the neighbours' or with Earth's compensation,
- the firmware's formats: folded, directions alone,
- how the error grows with each tolerance, one at a time,
- beside the published: deg per LSB at rest (0.38, IROS 2019), R2 at degree 5 (0.994, TUM 2025),
- time per frame.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibration.angle_estimator import AngleEstimator
from calibration.fit import Choice, FitReport, fit_array
from calibration.magnet_model import fold
from calibration.polynomial import PolynomialModel
from calibration.samples import JigSamples, Samples
from robominer_slam.layout import WhiskerLayout, thesis_grid
from sim_backend.floor_capture import floor_capture
from sim_backend.jig import jig_sweep, ring_sweep
from sim_backend.magnet import EARTH_MT, HallArray, Tolerances
from sim_backend.physics import hinge_angles, rod_direction

FloatArray = NDArray[np.float64]

SOURCES: dict[str, Callable[[WhiskerLayout, int, HallArray], Samples]] = {
    "jig": lambda layout, seed, hall: JigSamples.from_rows(jig_sweep(layout, seed, hall=hall).tolist()),
    "rings": lambda layout, seed, hall: ring_sweep(layout, seed, hall=hall),
    "floor": lambda layout, seed, hall: floor_capture(layout, seed, hall=hall),
}
SPLIT_DEG, LARGEST_DEG = 45.0, 70.0
FACTORS = (0.0, 1.0, 2.0, 4.0)


def errors(
    model: PolynomialModel,
    hall: HallArray,
    seed: int,
    frames: int,
    *,
    noise: bool = True,
    folded: bool = False,
    earth: bool = False,
) -> FloatArray:
    """True inclination (deg), error (deg), error over sigma, tip error (mm), valid; shape (5, frames * n)."""
    layout, rng = hall.layout, np.random.default_rng([seed, 77])
    shape = (frames, layout.count)
    inclination = np.arccos(rng.uniform(np.cos(np.deg2rad(LARGEST_DEG)), 1.0, shape))
    hinge = hinge_angles(inclination, rng.uniform(-np.pi, np.pi, shape))
    turn = np.zeros((frames, 3))
    turn[:, 2] = rng.uniform(-np.pi, np.pi, frames)
    R = Rotation.from_rotvec(turn).as_matrix()
    field = hall.field(hinge, R)
    step = hall.electronics.step_mT
    field = hall.sample(field, rng) if noise else np.round(field / step) * step
    field = fold(field) if folded else field
    estimator = AngleEstimator(model, EARTH_MT if earth else None)
    everyone = np.ones(layout.count, dtype=np.bool_)
    result = np.empty((5, *shape))
    for k, truth in enumerate(rod_direction(hinge)):
        a = estimator.angles(field[k], everyone, R[k] if earth else None)
        sigma = estimator.sigma(a.inclination)
        chord = np.linalg.norm(a.direction.T - truth, axis=-1)
        error = 2.0 * np.arcsin(np.clip(chord / 2.0, 0.0, 1.0))
        result[:, k] = (
            np.rad2deg(inclination[k]), np.rad2deg(error), error / sigma, 1e3 * chord * layout.length, a.valid,
        )  # fmt: skip
    return result.reshape(5, -1)


def figures(found: FloatArray) -> dict[str, float]:
    """RMS and 95 % of the direction's error in both ranges, the tip's RMS, shares within 2 sigma and valid."""
    valid = found[4] > 0.5
    low, high = valid & (found[0] < SPLIT_DEG), valid & (found[0] >= SPLIT_DEG)
    return {
        "rms_0_45_deg": float(np.sqrt(np.mean(found[1, low] ** 2))),
        "p95_0_45_deg": float(np.quantile(found[1, low], 0.95)),
        "rms_45_70_deg": float(np.sqrt(np.mean(found[1, high] ** 2))),
        "p95_45_70_deg": float(np.quantile(found[1, high], 0.95)),
        "tip_rms_mm": float(np.sqrt(np.mean(found[3, valid] ** 2))),
        "within_2_sigma": float(np.mean(found[2, valid] < 2.0)),
        "valid": float(np.mean(valid)),
    }


MODELS: tuple[Choice, ...] = ("physical", "polynomial")


def by_source(seeds: Sequence[int], frames: int) -> dict[str, dict[str, float]]:
    """Figures of every source and variant, all seeds together."""
    layout = thesis_grid()
    found: dict[str, list[FloatArray]] = {}
    physical: dict[str, list[float]] = {}
    for seed in seeds:
        hall = HallArray(layout, seed)
        for source, take in SOURCES.items():
            samples = take(layout, seed, hall)
            report = fit_array([samples], layout)
            physical.setdefault(source, []).append(report.chosen.count("physical") / layout.count)
            runs = {
                "chosen": errors(report.model, hall, seed, frames),
                "quantisation, no noise": errors(report.model, hall, seed, frames, noise=False),
                "no neighbours": errors(replace(report.model, neighbours=None), hall, seed, frames),
                "Earth too": errors(report.model, hall, seed, frames, earth=True),
            }
            for choice in MODELS:
                alone = fit_array([samples], layout, choose=choice)
                runs[f"{choice} alone"] = errors(alone.model, hall, seed, frames)
            if isinstance(samples, JigSamples):
                folded = replace(samples, field_mT=fold(samples.field_mT))
                model = fit_array([folded], layout, folded=True).model
                runs["folded"] = errors(model, hall, seed, frames, folded=True)
                model = fit_array([samples], layout, representation="Direction").model
                runs["directions alone"] = errors(model, hall, seed, frames)
            for name, run in runs.items():
                found.setdefault(f"{source}, {name}", []).append(run)
    table = {name: figures(np.concatenate(runs, axis=1)) for name, runs in found.items()}
    for source, shares in physical.items():
        table[f"{source}, chosen"]["physical_share"] = float(np.mean(shares))
    return table


def by_tolerance(seed: int, frames: int, source: str) -> dict[str, list[float]]:
    """RMS error (0 to 45 deg) with each tolerance at 0, 1, 2 and 4 times its value, the others at theirs."""
    layout, nominal = thesis_grid(), Tolerances()
    table = {}
    for one in fields(Tolerances):
        row = []
        for factor in FACTORS:
            spread = replace(nominal, **{one.name: factor * getattr(nominal, one.name)})
            hall = HallArray(layout, seed, tolerances=spread)
            report = fit_array([SOURCES[source](layout, seed, hall)], layout)
            row.append(figures(errors(report.model, hall, seed, frames))["rms_0_45_deg"])
        table[one.name] = row
    return table


def published(seed: int) -> dict[str, float]:
    """Degrees per LSB at rest, and the data-driven model's R2 at degree 5."""
    layout = thesis_grid()
    hall, step = HallArray(layout, seed), float(np.deg2rad(0.5))
    report: FitReport = fit_array([SOURCES["jig"](layout, seed, hall)], layout)
    slopes = []
    for azimuth in np.arange(0.0, np.pi, np.pi / 8):
        two = [
            hall.jig_field(np.broadcast_to(hinge_angles(np.array(s), np.array(azimuth)), (layout.count, 2)))
            for s in (step, -step)
        ]
        slopes.append(np.linalg.norm(two[0] - two[1], axis=-1) / (2.0 * np.rad2deg(step)))
    return {
        "deg_per_lsb_at_rest": float(hall.electronics.step_mT / np.mean(slopes)),
        "r_squared_degree_5": float(report.r_squared.mean()),
    }


def cost(seed: int, frames: int = 3000) -> dict[str, float]:
    """Milliseconds per frame of 64 whiskers: smooth motion, and every frame elsewhere (two evaluations)."""
    layout = thesis_grid()
    hall, rng = HallArray(layout, seed), np.random.default_rng(0)
    model = fit_array([SOURCES["jig"](layout, seed, hall)], layout).model
    valid, result = np.ones(layout.count, dtype=np.bool_), {}
    around = rng.uniform(-np.pi, np.pi, layout.count)
    for name, way in (("smooth", np.linspace(0.3, 0.6, frames)), ("jumping", rng.uniform(0.1, 1.1, frames))):
        hinge = hinge_angles(way[:, None], np.broadcast_to(around, (frames, layout.count)))
        field = hall.field(hinge, np.broadcast_to(np.eye(3), (frames, 3, 3)))
        estimator, times = AngleEstimator(model), []
        for frame in field:
            start = time.perf_counter()
            estimator.angles(frame, valid)
            times.append(time.perf_counter() - start)
        result[f"{name}_median_ms"] = 1e3 * float(np.median(times))
    return result


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=100, help="test frames per seed")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    result = {
        "sources": by_source(range(1, arguments.seeds + 1), arguments.frames),
        "tolerances": {source: by_tolerance(1, arguments.frames, source) for source in ("jig", "floor")},
        "published": published(1),
        "cost": cost(1),
    }
    if arguments.json:
        print(json.dumps(result))
        return
    for name, row in result["sources"].items():
        print(f"{name:32s}" + "  ".join(f"{key} {value:.3f}" for key, value in row.items()))
    for source, table in result["tolerances"].items():
        print(f"\nRMS over 0 to 45 deg by tolerance ({source}), factors {FACTORS}")
        for tolerance, row in table.items():
            print(f"{tolerance:20s}" + "  ".join(f"{value:.3f}" for value in row))
    print("\nPublished: 0.38 deg per LSB (IROS 2019), R2 0.994 at degree 5 (TUM 2025). Here:", result["published"])
    print("Cost per frame of 64 whiskers:", result["cost"])


if __name__ == "__main__":
    main()
