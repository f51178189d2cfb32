"""`robominer-slam replay`: a recording through the same pipeline as the daemon's."""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path

import click
from rich.console import Console
from rich.progress import Progress

from robominer_slam.evaluation.trajectory import tum_line
from robominer_slam.frame_result import FrameResult
from robominer_slam.graph_json import graph_json
from robominer_slam.replay import prepare
from robominer_slam.replay import replay as run_replay
from robominer_slam.replay_session import open_session
from robominer_slam.slam.keyframe import BackendResult
from robominer_slam.store import QUEUE_LENGTH

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
OUT = click.Path(dir_okay=False, path_type=Path)


@click.command(
    epilog="""Example: robominer-slam replay drive.mcap --config config.toml --tum slam.txt

Example of two sessions: robominer-slam replay monday.mcap --store mine.db, then
robominer-slam replay tuesday.mcap --map mine.db --start continue --store mine.db"""
)
@click.argument("file", type=FILE)
@click.option("--config", "config_file", type=FILE, help="Configuration; the recording's own by default.")
@click.option("--tum", type=OUT, help="Poses as they were published, stamped with sensor time.")
@click.option("--odometry-tum", type=OUT, help="Dead reckoning alone, likewise.")
@click.option("--graph", "graph_file", type=OUT, help="The pose graph at the end, as the JSON of map/graph.")
@click.option("--store", "store_file", type=OUT, help="Save the map in this database, as the daemon would.")
@click.option("--map", "map_name", help="Start in a saved map: DATABASE (the newest in it) or DATABASE:NAME.")
@click.option(
    "--start",
    type=click.Choice(["continue", "localize"]),
    help="In the saved map: go on mapping, or only follow the pose.  [default: [slam] start, else localize]",
)
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
def replay(
    file: Path,
    config_file: Path | None,
    tum: Path | None,
    odometry_tum: Path | None,
    graph_file: Path | None,
    store_file: Path | None,
    map_name: str | None,
    start: str | None,
    as_json: bool,
) -> None:
    """Run a recording through the pipeline, as fast as it goes."""
    inputs = prepare(file, config_file)
    inputs, session = open_session(inputs, map_name, start, store_file)
    begin = time.perf_counter()
    with contextlib.ExitStack() as stack:
        store = stack.enter_context(session.store) if session.store is not None else None
        poses = stack.enter_context(tum.open("w", encoding="utf-8")) if tum else None
        odometry = stack.enter_context(odometry_tum.open("w", encoding="utf-8")) if odometry_tum else None
        progress = stack.enter_context(Progress(console=Console(stderr=True), transient=True, disable=as_json))
        task = progress.add_task(file.name, total=max(inputs.recording.duration_ns, 1))
        first: list[int] = []

        def keep(result: BackendResult) -> None:
            if store is not None:
                store.add(result, 0)
                if store.waiting > QUEUE_LENGTH // 2:
                    store.flush(60.0)

        def on_frame(frame: FrameResult) -> None:
            for backend_result in frame.backend_results:
                keep(backend_result)
            if poses is not None:
                poses.write(tum_line(frame.stamp_ns, frame.T_map_base))
            if odometry is not None:
                odometry.write(tum_line(frame.stamp_ns, frame.T_odom_base))

        def on_message(log_time_ns: int) -> None:
            if not first:
                first.append(log_time_ns)
            progress.update(task, completed=log_time_ns - first[0])

        result = run_replay(inputs, on_frame, on_message, session.known, keep)
    seconds = time.perf_counter() - begin
    if graph_file is not None:
        graph_file.write_text(graph_json(result.keyframe_map, 0), encoding="utf-8")
    duration = inputs.recording.duration_ns * 1e-9
    summary = {
        "frames": result.frames,
        "duration_s": round(duration, 3),
        "seconds": round(seconds, 3),
        "real_time_factor": round(duration / seconds, 1) if seconds > 0 else None,
        "keyframes": len(result.keyframe_map.keyframes),
        "loop_closures": result.keyframe_map.closures,
        "tracking_frames": result.localised_frames,
        "late": result.late,
        "dropped": result.dropped,
        "counters": result.counters,
    }
    if as_json:
        click.echo(json.dumps(summary))
    else:
        click.echo(
            f"{result.frames} frames, {duration:.1f} s in {seconds:.1f} s ({summary['real_time_factor']} x real time); "
            f"{summary['keyframes']} keyframes, {summary['loop_closures']} loop closures; "
            f"late {result.late}, dropped {result.dropped}"
        )
