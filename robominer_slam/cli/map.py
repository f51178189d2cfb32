"""`robominer-slam map`: what is in saved maps, and maps in other programs' formats."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from robominer_slam.configuration.model import StoreSection
from robominer_slam.map_files.comparison import difference
from robominer_slam.map_files.formats import FORMATS, ExportSettings, cloud
from robominer_slam.map_files.octomap import OctomapSizeError
from robominer_slam.mapping.height_grid import GridSizeError
from robominer_slam.replay_session import split_name
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.store_reader import load_map, map_versions, maps_in

MAP = "DATABASE[:NAME]"
#: What `map info` tells of each map, and how a person reads it.
COLUMNS = {
    "id": "id",
    "name": "name",
    "created": "created (UTC)",
    "keyframes": "keyframes",
    "loop_closures": "loops",
    "points": "points",
    "distance_m": "driven (m)",
    "extent_m": "extent (m)",
}
#: The same of `map versions`.
VERSION_COLUMNS = {
    "number": "version",
    "written": "written (UTC)",
    "keyframes": "keyframes",
    "loop_closures": "loops",
    "moved": "moved",
    "moved_m_max": "by at most (m)",
}
HERE = StoreSection().path


@click.group("map", epilog="Example: robominer-slam map export map.db heights.tif --cell 0.02")
def map_group() -> None:
    """Saved maps: what is in them, in other programs' formats, and what differs between two."""


@map_group.command(epilog="Example: robominer-slam map info /var/lib/robominer-slam/map.db")
@click.argument("database", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def info(database: Path, as_json: bool) -> None:
    """What maps a database holds."""
    entries = [
        _described(one.number, one.created_unix_ns, load_map(database, str(one.number))[1]) for one in maps_in(database)
    ]
    if as_json:
        click.echo(json.dumps({"database": str(database), "bytes": database.stat().st_size, "maps": entries}))
        return
    _print(f"{database}: {database.stat().st_size / 1e6:.1f} MB", COLUMNS, entries)


@map_group.command(epilog=f"Example: robominer-slam map versions map.db:monday\n\nWithout DATABASE: {HERE}")
@click.argument("saved", metavar=f"[{MAP}]", default=HERE)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def versions(saved: str, as_json: bool) -> None:
    """When stored poses were corrected, how many, how far.

    Without NAME of the newest map.
    """
    database, wanted = split_name(saved)
    number, name, known = map_versions(database, wanted)
    entries = [
        {
            "number": one.number,
            "written": _utc(one.written_unix_ns),
            "keyframes": one.keyframes,
            "loop_closures": one.loop_closures,
            "moved": one.moved,
            "moved_m_max": round(one.moved_m, 6),
        }
        for one in known
    ]
    if as_json:
        click.echo(json.dumps({"database": str(database), "id": number, "name": name, "versions": entries}))
        return
    _print(f"{database}: versions of map {number} {name}".rstrip(), VERSION_COLUMNS, entries)


ENDINGS = "\n\n".join(f"{ending}: {what}." for ending, (what, _) in FORMATS.items())


@map_group.command(epilog=f"Example: robominer-slam map export map.db:monday mine.ply\n\n{ENDINGS}")
@click.argument("saved", metavar=MAP)
@click.argument("out", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--cell", default=0.02, show_default=True, help="Cell of height maps and grids, m.")
@click.option("--octree-cell", default=0.02, show_default=True, help="Cell of an OctoMap, m.")
@click.option("--obstacle-height", default=0.04, show_default=True, help="Step that makes an obstacle in a grid, m.")
def export(saved: str, out: Path, cell: float, octree_cell: float, obstacle_height: float) -> None:
    """Write a map in the format that the ending of OUT names."""
    for name, size in (("--cell", cell), ("--octree-cell", octree_cell), ("--obstacle-height", obstacle_height)):
        if not 0.001 <= size <= 10.0:
            raise click.BadParameter(f"{size:g}: expected 0.001 to 10 m", param_hint=name)
    if out.suffix not in FORMATS:
        raise click.BadParameter(f"{out.name!r}: expected an ending of {', '.join(FORMATS)}", param_hint="OUT")
    _, write = FORMATS[out.suffix]
    try:
        files = write(_loaded(saved), out, ExportSettings(cell, octree_cell, obstacle_height))
    except (GridSizeError, OctomapSizeError) as error:
        raise click.UsageError(f"{out.name}: {error}; take larger cells") from error
    except ImportError as error:
        raise click.UsageError(f"{out.name}: needs {error.name}; pip install 'robominer-slam[operator]'") from error
    for path, content in files.items():
        try:
            path.write_bytes(content)
        except OSError as error:
            raise click.UsageError(f"{path}: cannot be written: {error.strerror}") from error
        click.echo(f"{path}: {len(content)} bytes", err=True)


@map_group.command(epilog="Example: robominer-slam map diff map.db:monday map.db:tuesday")
@click.argument("first", metavar=MAP)
@click.argument("second", metavar=MAP)
@click.option("--cell", default=0.02, show_default=True, help="Cell in which heights are compared, m.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def diff(first: str, second: str, cell: float, as_json: bool) -> None:
    """What differs between two maps of one frame: poses by stamp, heights by cell."""
    found = difference(_loaded(first), _loaded(second), cell)
    figures = {
        "keyframes_common": found.common,
        "keyframes_only_first": found.only_first,
        "keyframes_only_second": found.only_second,
        "moved_m_mean": _mean(found.moved),
        "moved_m_max": _max(found.moved),
        "turned_deg_max": None if not found.common else float(np.rad2deg(found.turned.max())),
        "cells_common": found.cells_common,
        "cells_only_first": found.cells_first,
        "cells_only_second": found.cells_second,
        "height_m_mean": _mean(found.height),
        "height_m_rms": None if not len(found.height) else float(np.sqrt(np.mean(found.height**2))),
    }
    if as_json:
        click.echo(json.dumps(figures))
        return
    table = Table("figure", "value", title=f"{second} against {first}")
    for name, value in figures.items():
        table.add_row(name.replace("_", " "), _text(value))
    Console().print(table)


def _loaded(text: str) -> SavedMap:
    database, name = split_name(text)
    return load_map(database, name)[1]


def _described(number: int, created_ns: int, saved: SavedMap) -> dict[str, object]:
    points = cloud(saved)
    extent = np.ptp(points, axis=0).round(2).tolist() if len(points) else [0.0, 0.0, 0.0]
    return {
        "id": number,
        "name": "" if saved.name == str(number) else saved.name,
        "created": _utc(created_ns),
        "keyframes": len(saved.keyframes),
        "loop_closures": sum(edge.kind == "loop" for edge in saved.edges),
        "points": len(points),
        "distance_m": round(saved.keyframes[-1].travelled, 2) if saved.keyframes else 0.0,
        "extent_m": extent,
    }


def _utc(unix_ns: int) -> str:
    return str(np.datetime64(unix_ns, "ns").astype("datetime64[s]"))


def _print(title: str, columns: Mapping[str, str], entries: Sequence[Mapping[str, object]]) -> None:
    table = Table(title=title)
    for heading in columns.values():
        table.add_column(heading, justify="left" if heading == "name" or "UTC" in heading else "right")
    for entry in entries:
        table.add_row(*(_text(entry[key]) for key in columns))
    Console().print(table)


def _text(value: object) -> str:
    match value:
        case None:
            return "-"
        case float():
            return f"{value:.4g}"
        case list():
            return " x ".join(f"{part:.2f}" for part in value)
        case _:
            return str(value)


def _mean(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float | None:
    return float(values.mean()) if len(values) else None


def _max(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float | None:
    return float(values.max()) if len(values) else None
