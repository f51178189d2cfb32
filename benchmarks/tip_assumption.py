"""How far the tip assumption is from the true contact: per world and per inclination (docs/tip-assumption.md).

Usage: python -m benchmarks.tip_assumption [--seconds S] [--figure FILE.png] [--json]

The daemon takes the tip of a touching whisker as its contact, as the thesis does. The physics engine knows where
the surface really presses on the rod. Printed for every world, in the physics engine:

- share of touches along the shaft (farther than 3 % of the length from the tip),
- distance from the assumed contact (the tip's end) to the true one,
- height of the assumed contact above the true surface, which is what a height map gets wrong,
- the same by inclination over all worlds.

Distances are median / 95 % / 99 %.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from robominer_slam import layout as layouts
from sim_backend import world as worlds
from sim_backend.engines import base_motion_on, build_engine
from sim_backend.physics import rod_direction
from sim_backend.waypoints import WaypointPath

FloatArray = NDArray[np.float64]

WORLDS = ("thesis", "random:1", "random:2", "random:3", "random:4", "corridor", "flat", "flooded", "tunnel", "mine")
INTERVAL = 0.04
#: A touch farther than this share of the length from the tip is one along the shaft.
SHAFT = 0.03
BINS = np.deg2rad([0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 90.0])


@dataclass(frozen=True)
class Touches:
    """All touches of a drive.

    Attributes:
        inclination: shape (n,), rad.
        along: distance of the true contact from the tip's end, along the rod, shape (n,), m.
        distance: of the true contact from the tip's end, shape (n,), m.
        above: how far the tip's end is from the true surface, outward, shape (n,), m; heights on open ground,
            distances where there are walls.
        readings: whiskers read, touching or not.
    """

    inclination: FloatArray
    along: FloatArray
    distance: FloatArray
    above: FloatArray
    readings: int


def touches(name: str, seconds: float) -> Touches:
    """Drive scenario 1 of a world with the physics engine and note every touch; every second frame."""
    world = worlds.load(name)
    layout = layouts.BUILT_IN[world.layout]()
    motion = base_motion_on(world, WaypointPath(world.scenario(1)))
    engine = build_engine("physics", world, layout, motion, read_offset=np.zeros(layout.count), interval=INTERVAL)
    parts: list[tuple[FloatArray, ...]] = []
    frames = int(min(seconds, motion.duration) / INTERVAL)
    for k in range(frames):
        reading = engine.read()
        touching = reading.contact & np.isfinite(reading.contact_arm)
        if k % 2 or not touching.any():
            continue
        base = motion.at([k * INTERVAL])
        rod = np.einsum("nij,nj->ni", layout.R_base_whisker, rod_direction(reading.hinge))
        tip = base.position[0] + (layout.p_base + layout.length[:, None] * rod) @ base.R[0].T
        tip, point = tip[touching], reading.contact_point[touching]
        if world.walls is None:
            above = tip[:, 2] - world.height(tip[:, 0], tip[:, 1])
        else:
            gap, gradient = world.walls.gap(np.ascontiguousarray(tip.T))
            above = gap / np.linalg.norm(gradient, axis=0)
        along = layout.length[touching] - reading.contact_arm[touching]
        parts.append((reading.inclination[touching], along, np.linalg.norm(tip - point, axis=1), above))
    joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return Touches(*joined, readings=frames // 2 * int(layout.present.sum()))


def summary(t: Touches, length: float = 0.15) -> dict[str, float]:
    """The figures of a table's row; distances in mm."""
    if not len(t.along):
        return {"touches": 0}
    return {
        "touches": len(t.along),
        "shaft_percent": 100.0 * float(np.mean(t.along > SHAFT * length)),
        **{f"distance_{q}": 1e3 * float(np.percentile(t.distance, q)) for q in (50, 95, 99)},
        **{f"above_{q}": 1e3 * float(np.percentile(t.above, q)) for q in (50, 95, 99)},
    }


def by_inclination(all_touches: list[Touches]) -> list[tuple[str, Touches]]:
    """The touches of all worlds, by inclination."""
    angle = np.concatenate([t.inclination for t in all_touches])
    values = [np.concatenate([getattr(t, name) for t in all_touches]) for name in ("along", "distance", "above")]
    found = []
    for low, high in pairwise(BINS):
        inside = (angle >= low) & (angle < high)
        label = f"{np.rad2deg(low):.0f} to {np.rad2deg(high):.0f} deg"
        found.append((label, Touches(angle[inside], *(value[inside] for value in values), readings=int(inside.sum()))))
    return found


def print_table(title: str, rows: list[tuple[str, Touches]]) -> None:
    heads = (title, "touches", "along the shaft", "true contact to tip (mm)", "tip above surface (mm)")
    print(f"\n| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for name, t in rows:
        s = summary(t)
        if s["touches"] == 0:
            print(f"| {name} | 0 | - | - | - |")
            continue
        distance = " / ".join(f"{s[f'distance_{q}']:.1f}" for q in (50, 95, 99))
        above = " / ".join(f"{s[f'above_{q}']:.1f}" for q in (50, 95, 99))
        print(f"| {name} | {s['touches']} | {s['shaft_percent']:.2f} % | {distance} | {above} |")


def draw(rows: list[tuple[str, Touches]], inclinations: list[tuple[str, Touches]], path: Path) -> None:
    """Two plots: distance by world, height error by inclination."""
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    colours = ("#0072b2", "#e69f00", "#d55e00")
    for axes, groups, label, what in (
        (left, rows, "world", "distance"),
        (right, inclinations, "inclination", "above"),
    ):
        names = [name.removesuffix(" deg") for name, t in groups if len(t.along)]
        place = np.arange(len(names))
        for k, q in enumerate((50, 95, 99)):
            value = [1e3 * np.percentile(getattr(t, what), q) for _, t in groups if len(t.along)]
            axes.bar(place + 0.27 * (k - 1), value, 0.27, color=colours[k], label=f"{q} %" if q != 50 else "median")
        axes.set_xticks(place, names, rotation=35, ha="right")
        axes.set_xlabel(label + (" (deg)" if label == "inclination" else ""))
        axes.grid(axis="y", alpha=0.3)
        axes.legend()
    left.set_ylabel("true contact to assumed tip (mm)")
    right.set_ylabel("assumed tip above the true surface (mm)")
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=120.0, help="of scenario 1, in every world")
    parser.add_argument("--figure", type=Path, help="write the plots to this file")
    parser.add_argument("--worlds", nargs="+", default=WORLDS, help="worlds to drive in")
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args()
    with ProcessPoolExecutor(max_workers=2) as pool:
        found = list(pool.map(touches, args.worlds, [args.seconds] * len(args.worlds)))
    rows = list(zip(args.worlds, found, strict=True))
    inclinations = by_inclination(found)
    if args.json:
        print(json.dumps({name: summary(t) for name, t in [*rows, *inclinations]}))
    else:
        print_table("world", rows)
        print_table("inclination", inclinations)
    if args.figure is not None:
        draw(rows, inclinations, args.figure)


if __name__ == "__main__":
    main()
