"""What the operator sees during a capture: the array as a table and a progress bar, or one JSON line per event."""

from __future__ import annotations

import json
from dataclasses import asdict

import click
import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from calibration.capture_coverage import StepCoverage
from calibration.capture_labels import CaptureStep
from calibration.polynomial import dipole_coordinates
from drivers.measurement import HallFrame

FloatArray = NDArray[np.float64]

#: Redraws a second: enough to steer by, little for a board.
REDRAWS = 8
#: Colours of the inclination from 0 deg on, every 10 deg.
COLOURS = ("green", "cyan", "blue", "magenta", "yellow", "red", "bright_red", "bright_red")


class LiveScreen:
    """The array's inclinations in the terminal; use as a context manager."""

    def __init__(self, rows: int, cols: int, console: Console) -> None:
        self._rows, self._cols = rows, cols
        self._progress = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        self._steps = self._progress.add_task("steps", total=1)
        self._part = self._progress.add_task("this step", total=100)
        self._instruction, self._problem = "", ""
        self._bad: NDArray[np.bool_] | None = None
        self._frame: tuple[HallFrame, FloatArray | None] | None = None
        self._live = Live(console=console, refresh_per_second=REDRAWS, get_renderable=self._render)

    def __enter__(self) -> LiveScreen:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def step(self, number: int, count: int, step: CaptureStep, attempt: int) -> None:
        """A step begins."""
        self._progress.update(self._steps, total=count, completed=number)
        self._progress.update(self._part, completed=0)
        again = "Again: " if attempt else ""
        self._instruction = f"{again}{step.instruction()}  Enter: go on; s and Enter: leave it out."
        if not attempt:
            self._problem, self._bad = "", None

    def frame(self, frame: HallFrame, rest_mT: FloatArray | None, share: float) -> None:
        """A frame came."""
        self._progress.update(self._part, completed=round(100 * share))
        self._frame = frame, rest_mT

    def judged(self, number: int, coverage: StepCoverage) -> None:
        """A step was captured."""
        self._progress.update(self._steps, completed=number + 1)
        self._problem, self._bad = coverage.problem, ~coverage.enough

    def _render(self) -> Group:
        parts: list[Text | Table | Progress] = [Text(self._instruction, style="bold")]
        if self._problem:
            parts.append(Text(f"Not enough: {self._problem}", style="bold red"))
        if self._frame is not None:
            parts.append(array_table(*self._frame, self._rows, self._cols, self._bad))
        return Group(*parts, self._progress)


def array_table(
    frame: HallFrame, rest_mT: FloatArray | None, rows: int, cols: int, bad: NDArray[np.bool_] | None
) -> Table:
    """The array, a cell per whisker: inclination from the field's turn since rest, deg; |B| in mT before rest."""
    field, valid = frame.field_mT.reshape(-1, 3), frame.valid.reshape(-1)
    table = Table(title="|B|, mT" if rest_mT is None else "inclination, deg (before calibration)", pad_edge=False)
    table.add_column("row")
    for col in range(cols):
        table.add_column(str(col), justify="right")
    if rest_mT is None:
        values = np.linalg.norm(field, axis=-1)
    else:
        turned = dipole_coordinates(field, rest_mT) - dipole_coordinates(rest_mT, rest_mT)
        values = np.rad2deg(np.hypot(turned[:, 0], turned[:, 1]))
    for row in range(rows):
        cells = []
        for i in range(row * cols, (row + 1) * cols):
            if not valid[i] or not field[i].any():
                cells.append("[dim]dead[/]")
                continue
            colour = "white" if rest_mT is None else COLOURS[min(int(values[i] / 10.0), len(COLOURS) - 1)]
            mark = "[bold red]![/]" if bad is not None and bad[i] else ""
            cells.append(f"{mark}[{colour}]{values[i]:.0f}[/]")
        table.add_row(str(row), *cells)
    return table


class EventScreen:
    """One JSON object per line on standard output: for scripts that move a jig."""

    def __enter__(self) -> EventScreen:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def step(self, number: int, count: int, step: CaptureStep, attempt: int) -> None:
        """A step begins."""
        known = {key: value for key, value in asdict(step).items() if value is not None}
        self._print({"event": "step", "number": number, "count": count, "attempt": attempt, **known})

    def frame(self, frame: HallFrame, rest_mT: FloatArray | None, share: float) -> None:
        """A frame came; scripts need not know."""

    def judged(self, number: int, coverage: StepCoverage) -> None:
        """A step was captured."""
        frames = int(coverage.frames.max(initial=0))
        self._print({"event": "captured", "number": number, "frames": frames, "problem": coverage.problem})

    def _print(self, values: dict[str, object]) -> None:
        click.echo(json.dumps(values))
