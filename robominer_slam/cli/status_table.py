"""What a daemon says of itself, as tables and as JSON."""

from __future__ import annotations

from typing import Any

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table

from drivers.ros_messages import deserialize
from robominer_slam.publishing.report_messages import DIAGNOSTIC_ARRAY, Level

#: Keys of the whiskers that are not well, as `status_report.py` writes them: `whisker (row, column)`.
WHISKER = "whisker "
COLOURS = {Level.OK: "green", Level.WARN: "yellow", Level.ERROR: "red", Level.STALE: "magenta"}


def entries_of(payload: bytes) -> list[Any]:
    """The entries of a `status` message."""
    return list(deserialize(payload, DIAGNOSTIC_ARRAY).status)


def described(entries: list[Any]) -> list[dict[str, Any]]:
    """Entries for JSON."""
    return [
        {
            "name": entry.name,
            "level": Level(entry.level).name,
            "message": entry.message,
            "values": {value.key: value.value for value in entry.values},
        }
        for entry in entries
    ]


def tables(title: str, entries: list[Any], *, flat: bool = False) -> RenderableType:
    """Entries for the eye; whiskers that are left out in a table of their own.

    Args:
        title: above it.
        entries: of a message.
        flat: figures side by side, so that the whole fits on a screen.
    """
    table = Table(title=title)
    for column in ("part", "level", "says", "figures"):
        table.add_column(column)
    for entry in entries:
        level = Level(entry.level)
        shown = [value for value in entry.values if value.value and not value.key.startswith(WHISKER)]
        figures = (", " if flat else "\n").join(f"{value.key} = {value.value}" for value in shown)
        table.add_row(entry.name, f"[{COLOURS[level]}]{level.name}[/]", escape(entry.message), escape(figures))
    unwell = [
        (value.key.removeprefix(WHISKER).strip("()"), value.value)
        for entry in entries
        for value in entry.values
        if value.key.startswith(WHISKER)
    ]
    if not unwell:
        return table
    whiskers = Table(title="whiskers left out of the map")
    for column in ("row, column", "state"):
        whiskers.add_column(column)
    for place, state in unwell:
        whiskers.add_row(place, state)
    return Group(table, whiskers)
