"""Time per whisker frame and per keyframe on recordings, by replay.

    python -m benchmarks.replay_times [RECORDING ...] [--source odometry|fused]

Frames are timed without the back-end and without reading the recording, keyframes are the back-end's own time. Wall
time of one thread: on a shared machine, quote the least of several runs.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np

from robominer_slam.assembly import build_pipeline
from robominer_slam.configuration.overrides import overridden
from robominer_slam.replay import KIND_DEVICES, ReplayInputs, prepare

RECORDINGS = Path(__file__).resolve().parents[1] / "tests" / "recordings"


def times_ms(inputs: ReplayInputs) -> tuple[list[float], list[float]]:
    """Times of frames without the back-end (reading the recording left out), and of keyframes in the back-end, ms."""
    pipeline = build_pipeline(inputs.configuration, inputs.layout, inputs.model, "synchronous")
    if pipeline.runner is None:
        raise ValueError("the method has no back-end to time; expected robust or thesis")
    frames: list[float] = []
    keyframes: list[float] = []
    spent = busy = 0.0
    for _, measurement in inputs.recording:
        device = KIND_DEVICES.get(type(measurement).__name__, "screws")
        start = perf_counter()
        results = pipeline.add(device, measurement)
        spent += perf_counter() - start
        inside, busy = pipeline.runner.busy_s - busy, pipeline.runner.busy_s
        spent -= inside
        if inside > 0.0:
            keyframes.append(1e3 * inside)
        if results:
            frames.append(1e3 * spent / len(results))
            spent = 0.0
    return frames, keyframes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path, default=sorted(RECORDINGS.glob("*.mcap")))
    parser.add_argument("--source", choices=("odometry", "fused"), default="fused")
    arguments = parser.parse_args()
    print(
        f"{'recording':<16} {'frames':>7} {'mean ms':>8} {'p99 ms':>8} {'keyframes':>10} {'mean ms':>8} {'p99 ms':>8}"
    )
    for path in arguments.recordings:
        inputs = prepare(path, None)
        keys = {"slam.method": "robust", "estimation.source": arguments.source}
        inputs = replace(inputs, configuration=overridden(inputs.configuration, keys, path.name))
        frames, keyframes = times_ms(inputs)
        print(
            f"{path.stem:<16} {len(frames):>7} {np.mean(frames):>8.2f} {np.percentile(frames, 99):>8.2f} "
            f"{len(keyframes):>10} {np.mean(keyframes):>8.1f} {np.percentile(keyframes, 99):>8.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
