"""Robot and operator over a slow radio that breaks: how late poses are, what it costs, whether the maps are equal.

    python -m benchmarks.remote_link [--recording FILE.mcap] [--outages 10] [--rate 64] [--seed 1] [--only NAME]

Makes network namespaces with a rate limit between them and sets the link down and up: needs root and iproute2, and ends
with 2 where it cannot. The robot has TLS with keys of its own. By default it is `benchmarks.link_robot`, which has no
SLAM; with a recording, `drive`, `outages` and `down` are the daemon itself, and the recording's devices are served in
real time.

    drive    nothing fails: kbit/s on the wire, bytes by topic
    outages  2 s without link in each minute, and a correction of the whole map now and then
    random   N outages of 0.2 to 6 s, 1 to 6 s apart: is the digest the robot's?
    late     joins when the map has about 1 MB
    away     60 s without link, in which the robot makes the map of 10 minutes, ten times as fast
    down     two minutes with link and two without: the robot's memory
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.link_daemon import SimulatedDaemon
from benchmarks.link_namespaces import Link, NamespacesError
from benchmarks.link_scenario import Outages, Result, Scenario

#: Keyframes of `late`: about 1 MB of map stream; and of the others, some 20 m.
LARGE_MAP, SMALL_MAP = "4800", "80"
AWAY_S, DOWN_S = 60.0, 120.0
POINT_BYTES = 12
HEAD = (
    f"{'run':<8} {'pose late s: median':>20} {'95 %':>6} {'max':>6} {'kbit/s':>7} {'up':>5} {'joined s':>9} "
    f"{'returns':>8} {'first pose s':>13} {'map equal s: median':>20} {'max':>6} {'digest':>8} {'RSS MB':>14}"
)


def line(name: str, result: Result) -> str:
    """A row of the table."""
    equal, heard = result.equal_s, result.heard_s
    joined = "never" if result.joined_s is None else f"{result.joined_s:.1f}"
    return (
        f"{name:<8} {result.late(50):>20.3f} {result.late(95):>6.2f} {result.late(100):>6.2f} "
        f"{result.kbit_down:>7.1f} {result.kbit_up:>5.1f} {joined:>9} {len(heard):>8} "
        f"{np.median(heard) if heard else 0.0:>13.1f} {np.median(equal) if equal else 0.0:>20.1f} "
        f"{max(equal, default=0.0):>6.1f} {'equal' if result.equal else 'DIFFERS':>8} "
        f"{result.resident_mb[0]:>6.1f} {result.resident_mb[-1]:>7.1f}"
    )


def topics(result: Result) -> str:
    """Payload by topic; headers of Zenoh, TLS and TCP take the rest of what is on the wire."""
    rows = [
        f"  {key:<16} {result.messages[key]:>6} messages {result.payload[key]:>9} bytes "
        f"{result.payload[key] * 8e-3 / result.seconds:>6.2f} kbit/s"
        for key in sorted(result.payload)
    ]
    rows.append(f"  {'map/snapshot':<16} {'':>6} answers  {result.map_bytes:>9} bytes")
    return "\n".join(rows)


def random_outages(count: int, seed: int) -> Outages:
    """Seconds up and down."""
    rng = np.random.default_rng(seed)
    return [(float(rng.uniform(1.0, 6.0)), float(rng.uniform(0.2, 6.0))) for _ in range(count)]


def cloud_line(log: Path) -> str:
    """What a PointCloud2 of the map costs, by what the robot says of it."""
    said = next(json.loads(line) for line in log.read_text().splitlines() if '"ready"' in line)
    cloud = said["points"] * POINT_BYTES
    return (
        f"For comparison: a map of {said['snapshot_bytes'] / 1e6:.2f} MB here is {cloud / 1e6:.1f} MB as PointCloud2 "
        f"(x y z f32): {cloud * 8 / 64e3 / 60:.0f} minutes at 64 kbit/s each time that it is published."
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--outages", type=int, default=10)
    parser.add_argument("--minutes", type=float, default=3.0, help="Of `drive` and `outages`.")
    parser.add_argument("--rate", type=float, default=64.0, help="Of the link, kbit/s.")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=("drive", "outages", "random", "late", "away", "down"), action="append")
    arguments = parser.parse_args()
    minutes = max(1, round(arguments.minutes))

    def robot(scenario: Scenario, folder: Path, *synthetic: str) -> tuple[list[str], str]:
        if arguments.recording is None:
            return scenario.synthetic(*synthetic), '"ready"'
        return daemon.command(scenario, folder), "publishing poses under"

    def drive(scenario: Scenario, folder: Path) -> Result:
        command, ready = robot(scenario, folder, "--keyframes", SMALL_MAP)
        return scenario.run(command, [], settle_s=60.0 * minutes, ready=ready)

    def outages(scenario: Scenario, folder: Path) -> Result:
        command, ready = robot(scenario, folder, "--keyframes", SMALL_MAP, "--correct-every", "20")
        return scenario.run(command, [(58.0, 2.0)] * minutes, settle_s=20.0, ready=ready)

    def at_random(scenario: Scenario, folder: Path) -> Result:
        command, ready = robot(scenario, folder, "--keyframes", SMALL_MAP, "--correct-every", "5")
        return scenario.run(command, random_outages(arguments.outages, arguments.seed), settle_s=20.0, ready=ready)

    def late(scenario: Scenario, _: Path) -> Result:
        return scenario.run(scenario.synthetic("--keyframes", LARGE_MAP), [], settle_s=240.0)

    def away(scenario: Scenario, _: Path) -> Result:
        command = scenario.synthetic("--keyframes", SMALL_MAP, "--step", "0.17", "--hurry", "72")
        return scenario.run(command, [(10.0, AWAY_S)], settle_s=30.0)

    def down(scenario: Scenario, folder: Path) -> Result:
        command, ready = robot(scenario, folder, "--keyframes", SMALL_MAP)
        return scenario.run(command, [(DOWN_S, DOWN_S)], settle_s=15.0, ready=ready)

    runs: dict[str, Callable[[Scenario, Path], Result]] = {
        "drive": drive, "outages": outages, "random": at_random, "late": late, "away": away, "down": down,
    }  # fmt: skip
    print(HEAD, flush=True)
    for name, run in runs.items():
        if arguments.only and name not in arguments.only:
            continue
        with tempfile.TemporaryDirectory() as text:
            folder = Path(text)
            try:
                with Link(arguments.rate) as link, SimulatedDaemon(arguments.recording) as daemon:
                    result = run(Scenario(folder, link), folder)
            except NamespacesError as error:
                print(error, file=sys.stderr)
                return 2
            print(line(name, result))
            print(topics(result), flush=True)
            if name == "down":
                begun, ended = result.down_mb
                print(f"Robot's memory, MB: {begun:.1f} before and {ended:.1f} after the outage.")
            if name == "late":
                print(cloud_line(folder / "robot.log"), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
