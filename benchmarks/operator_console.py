"""The operator's console with a large map: script time and frame rate, latency, memory over time.

A made-up robot publishes a map of 1 km and 1 million points and drives on at 25 frames a second, with ten new
keyframes a second; the console shows it in the system's Chromium, which is traced. All on this machine, drawn in
software where there is no graphics card.

    python -m benchmarks.operator_console --minutes 60 --out out/operator
"""

from __future__ import annotations

import json
import math
import time
from pathlib import Path

import click
import numpy as np
from playwright.sync_api import CDPSession, Page

from robominer_slam import geometry
from tests.operator_page import browser, console, free_port, opened, stats
from tests.published_robot import MadeKeyframe, PublishedRobot, keyframe

LENGTH_M = 1000.0
STEP_M = 0.12
POINTS = 1_000_000
#: Ten map updates a second while the robot drives at 0.3 m/s.
KEYFRAME_M = 0.03
TRACED_S = 12.0
#: Events that stand for script on the main thread; those inside others are counted once.
SCRIPT_EVENTS = {
    "FunctionCall", "EvaluateScript", "EventDispatch", "TimerFire", "FireAnimationFrame", "RunMicrotasks",
    "v8.callFunction", "MinorGC", "MajorGC", "WebSocketReceive", "WebSocketMessage",
}  # fmt: skip
CATEGORIES = ["devtools.timeline", "v8", "v8.execute", "disabled-by-default-devtools.timeline", "toplevel"]


def large_map() -> tuple[list[MadeKeyframe], np.ndarray]:
    """Keyframes along a winding way of 1 km, a million points."""
    rng = np.random.default_rng(0)
    count = int(LENGTH_M / STEP_M)
    yaw = 1.2 * np.sin(np.arange(count) * STEP_M / 9.0)
    x, y = np.cumsum(STEP_M * np.cos(yaw)), np.cumsum(STEP_M * np.sin(yaw))
    poses = np.column_stack([x - x[-1], y - y[-1], yaw])
    # Each keyframe has fewer points than were made, where two fall on the same millimetre: some more.
    made = [keyframe(k, pose, math.ceil(POINTS / count) + 1, rng) for k, pose in enumerate(poses)]
    return made, geometry.to_vector7(geometry.T_from_xyyaw(poses))


def script_per_frame(trace: dict[str, list[dict]]) -> tuple[np.ndarray, np.ndarray, float]:
    """Script on the page's main thread between one animation frame and the next: wall and CPU ms; and frames per s."""
    events = trace["traceEvents"]
    threads = {
        (e["pid"], e["tid"]) for e in events if e["name"] == "thread_name" and e["args"]["name"] == "CrRendererMain"
    }
    script = sorted(
        (e for e in events if e.get("ph") == "X" and e["name"] in SCRIPT_EVENTS and (e["pid"], e["tid"]) in threads),
        key=lambda e: (e["ts"], -e.get("dur", 0)),
    )
    outer, end = [], 0.0
    for event in script:
        if event["ts"] >= end:
            outer.append(event)
            end = event["ts"] + event.get("dur", 0)
    frames = np.array([e["ts"] for e in script if e["name"] == "FireAnimationFrame"])
    place = np.searchsorted(frames, [e["ts"] for e in outer], side="right")
    inside = (place > 0) & (place < len(frames))
    wall = np.bincount(place[inside], [e.get("dur", 0) * 1e-3 for e, k in zip(outer, inside, strict=True) if k])
    cpu = np.bincount(place[inside], [e.get("tdur", 0) * 1e-3 for e, k in zip(outer, inside, strict=True) if k])
    return wall[1:], cpu[1:], (len(frames) - 1) / ((frames[-1] - frames[0]) * 1e-6)


def watched(page: Page, seconds: float) -> np.ndarray:
    """Latencies from stamp to scene seen over some seconds, ms."""
    seen, frames, end = [], -1.0, time.monotonic() + seconds
    while time.monotonic() < end:
        now = stats(page)
        if now["frames"] != frames and now["latency"] is not None:
            frames = now["frames"]
            seen.append(now["latency"])
        time.sleep(0.03)
    return np.array(seen)


def heap_mb(session: CDPSession) -> float:
    """The page's heap of JavaScript after a collection."""
    session.send("HeapProfiler.collectGarbage")
    return float(session.send("Runtime.getHeapUsage")["usedSize"]) / 1e6


def resident_mb(name: str) -> float:
    """Memory of the console's process."""
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            command = (status.parent / "cmdline").read_bytes()
            if name.encode() in command and b"operator" in command:
                lines = status.read_text().splitlines()
                return next(float(line.split()[1]) / 1e3 for line in lines if line.startswith("VmRSS"))
        except OSError:
            continue
    return math.nan


def quantiles(values: np.ndarray) -> str:
    """Median, 95 %, largest."""
    return f"{np.median(values):.1f} / {np.percentile(values, 95):.1f} / {values.max():.1f}"


@click.command()
@click.option("--minutes", default=10.0, show_default=True, help="How long memory is watched.")
@click.option("--points/--no-points", "large", default=True, help="With the large map, or from an empty one.")
@click.option("--keyframes", type=int, help="Most in the robot's map, as in a bounded one; default: no limit.")
@click.option("--window", default="1440x900", show_default=True, help="Size of the page, pixels.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("out/operator"), show_default=True)
def main(minutes: float, large: bool, keyframes: int | None, window: str, out: Path) -> None:
    """Measure and print a table."""
    out.mkdir(parents=True, exist_ok=True)
    robot = PublishedRobot(
        f"tcp/127.0.0.1:{free_port()}", points=60, keyframe_m=KEYFRAME_M if large else STEP_M, most_keyframes=keyframes
    )
    if large:
        robot.preload(*large_map())
    rows: list[tuple[str, str]] = []
    with robot, console(out / "operator.log", "--connect", robot.endpoint) as address, browser() as chromium:
        begin = time.monotonic()
        width, height = map(int, window.split("x"))
        page = opened(chromium, address, width, height)
        wanted = 990_000 if large else 1
        page.wait_for_function(
            f"parseInt((document.querySelector('.map-count')?.textContent ?? '0').replaceAll(',', '')) >= {wanted}",
            timeout=120_000,
        )
        rows.append(("points in the map", page.locator(".map-count").inner_text()))
        rows.append(("from opening the page to the whole map (s)", f"{time.monotonic() - begin:.1f}"))
        for mode, key in (("in 3D, following", "p"), ("from above, whole map", "t")):
            page.keyboard.press(key)
            if key == "t":
                page.keyboard.press("a")
            time.sleep(4.0)
            chromium.start_tracing(page=page, path=out / f"trace-{key}.json", categories=CATEGORIES)
            latency = watched(page, TRACED_S)
            chromium.stop_tracing()
            wall, cpu, rate = script_per_frame(json.loads((out / f"trace-{key}.json").read_text()))
            rows.append((f"{mode}: script per frame, median / 95 % / most (ms)", quantiles(wall)))
            rows.append((f"{mode}: the same in CPU time (ms)", quantiles(cpu)))
            rows.append((f"{mode}: stamp to scene, median / 95 % / most (ms)", quantiles(latency)))
            rows.append((f"{mode}: frames per second, share of points", f"{rate:.1f}, {stats(page)['detail']:.2f}"))
        page.keyboard.press("p")
        page.keyboard.press("f")
        session = page.context.new_cdp_session(page)
        samples, end = [], time.monotonic() + 60.0 * minutes
        while True:
            samples.append((heap_mb(session), resident_mb(robot.endpoint)))
            if time.monotonic() >= end:
                break
            time.sleep(min(60.0, max(0.0, end - time.monotonic())))
        heap, resident = np.array(samples).T
        third = max(1, len(samples) // 3)
        for name, values in (("page's heap", heap), ("console's process", resident)):
            text = f"{values[:third].mean():.1f} -> {values[-third:].mean():.1f}, most {values.max():.1f}"
            rows.append((f"{name} over {minutes:g} min, first -> last third (MB)", text))
        (out / "memory.json").write_text(json.dumps(samples))
    width = max(len(name) for name, _ in rows)
    table = "\n".join(f"{name:{width}}  {value}" for name, value in rows)
    (out / "table.txt").write_text(table + "\n")
    click.echo(table)


if __name__ == "__main__":
    main()
