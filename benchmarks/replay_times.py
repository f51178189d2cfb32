"""CPU time per whisker frame and per keyframe on recordings, by replay.

    python -m benchmarks.replay_times [RECORDING ...] [--source odometry|fused]

Frames are timed without the back-end, keyframes are the back-end's own time. CPU time does not count what other
processes take, but a shared machine makes it larger all the same.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from time import thread_time

import numpy as np

from robominer_slam.configuration.overrides import overridden
from robominer_slam.frame_result import FrameResult
from robominer_slam.replay import ReplayInputs, prepare, replay
from robominer_slam.slam.keyframe import BackendResult, Keyframe
from robominer_slam.slam.robust import RobustBackend

RECORDINGS = Path(__file__).resolve().parents[1] / "tests" / "recordings"


def times_ms(inputs: ReplayInputs) -> tuple[list[float], list[float]]:
    """CPU times of frames without the back-end, and of keyframes in the back-end, ms."""
    frames: list[float] = []
    keyframes: list[float] = []
    process = RobustBackend.process
    last, inside = thread_time(), 0.0

    def timed(backend: RobustBackend, keyframe: Keyframe) -> BackendResult:
        nonlocal inside
        start = thread_time()
        result = process(backend, keyframe)
        inside += thread_time() - start
        keyframes.append(1e3 * (thread_time() - start))
        return result

    def on_frame(_: FrameResult) -> None:
        nonlocal last, inside
        now = thread_time()
        frames.append(1e3 * (now - last - inside))
        last, inside = now, 0.0

    RobustBackend.process = timed  # type: ignore[method-assign]
    try:
        replay(inputs, on_frame)
    finally:
        RobustBackend.process = process  # type: ignore[method-assign]
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
