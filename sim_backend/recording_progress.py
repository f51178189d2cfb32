"""A progress bar on stderr for recordings, where someone looks at a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


@contextmanager
def progress_bar(description: str, console: Console | None = None) -> Iterator[Callable[[float], None] | None]:
    """Show a bar; yields what takes the share that is done (0 to 1), or None where there is no terminal.

    Args:
        description: text before the bar.
        console: where to; stderr by default.
    """
    shown_on = console or Console(stderr=True)
    if not shown_on.is_terminal:
        yield None
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=shown_on) as progress:
        task = progress.add_task(description, total=1.0)
        yield lambda share: progress.update(task, completed=share)
        progress.update(task, completed=1.0)
