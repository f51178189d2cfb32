"""Commands to the robot: each is confirmed first, and what came of it stays to be read."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from nicegui import run, ui

from robominer_slam.operator.commands import Outcome
from robominer_slam.operator.session import Session

#: Reads the answers: a command's name and parameters.
_Command: TypeAlias = Callable[[], tuple[str, dict[str, str]]]

WORDS = {Outcome.DONE: "done", Outcome.REFUSED: "refused", Outcome.UNANSWERED: "not answered"}
#: Of `localize`: how well the operator knows the place, m.
DEFAULT_SIGMA_M = 0.3


class CommandPanel:
    """The commands of one page."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._results: list[ui.label] = []

    def drive_commands(self) -> None:
        """Pause, resume, re-zero."""
        with ui.element("div").classes("buttons"):
            self._button("Pause mapping", "pause", "Mapping stops; the pose goes on by dead reckoning.").classes(
                "when-mapping"
            )
            self._button("Resume mapping", "resume", "Mapping goes on from where the robot is now.").classes(
                "when-paused"
            )
            self._button(
                "Re-zero whiskers", "rezero", "Every whisker's present reading becomes its rest: no whisker may touch."
            )
        self._result()

    def map_commands(self) -> None:
        """Save the map, begin another, say where the robot is."""
        with ui.element("div").classes("buttons"):
            ui.button("Save map …", on_click=self._save_map, color=None).props("no-caps unelevated")
            self._button("New map", "new_map", "The robot begins an empty map here. The present one stays stored.")
            ui.button("Localise …", on_click=lambda: self._localize({}), color=None).props("no-caps unelevated")
        self._result()

    def place(self, place: Mapping[str, Any]) -> None:
        """A place was shown on the map with a tool."""
        if place["tool"] == "localize":
            self._localize(place)
        else:
            self._waypoint(place)

    def _button(self, text: str, name: str, consequence: str) -> ui.button:
        def ask() -> None:
            self._confirm(text, consequence, lambda: lambda: (name, {}))

        return ui.button(text, on_click=ask, color=None).props(f"no-caps unelevated data-testid=cmd-{name}")

    def _result(self) -> None:
        self._results.append(ui.label("").classes("command-result").props('role=status data-testid="command-result"'))

    def _save_map(self) -> None:
        def ask() -> _Command:
            name = ui.input("Name of the map", placeholder="such as level 2").props("outlined dense autofocus")
            return lambda: ("save_map", {"name": _selector_value(name.value)} if name.value else {})

        self._confirm("Save map", "The map is written to the robot's disk.", ask)

    def _localize(self, place: Mapping[str, Any]) -> None:
        def ask() -> _Command:
            x = ui.number("x (m)", value=round(place.get("x", 0.0), 2), step=0.1, format="%.2f")
            y = ui.number("y (m)", value=round(place.get("y", 0.0), 2), step=0.1, format="%.2f")
            heading = ui.number("heading (°)", value=round(math.degrees(place.get("yaw") or 0.0)), step=5)
            sigma = ui.number("known within (m, 1σ)", value=DEFAULT_SIGMA_M, step=0.1, min=0.02, max=10.0)
            return lambda: (
                "localize",
                {
                    "x": f"{x.value or 0.0:.3f}",
                    "y": f"{y.value or 0.0:.3f}",
                    "yaw": f"{math.radians(heading.value or 0.0):.4f}",
                    "sigma": f"{sigma.value or DEFAULT_SIGMA_M:.3f}",
                },
            )

        self._confirm("Localise", "The robot looks for its place near here.", ask)

    def _waypoint(self, place: Mapping[str, Any]) -> None:
        x, y, yaw = float(place["x"]), float(place["y"]), place["yaw"]
        if yaw is None:
            live = self._session.view.live
            yaw = 0.0 if live is None else math.atan2(y - live.pose[1], x - live.pose[0])
        text = f"The simulated robot drives to x {x:.2f} m, y {y:.2f} m, heading {math.degrees(yaw):.0f}°."
        parameters = {"x": f"{x:.3f}", "y": f"{y:.3f}", "yaw": f"{yaw:.4f}"}
        self._confirm("Add waypoint", text, lambda: lambda: ("sim/waypoint", parameters))

    def _confirm(self, title: str, consequence: str, ask: Callable[[], _Command]) -> None:
        """Ask; on Yes do it, and say what came of it.

        Args:
            title: what is to be done.
            consequence: what it means.
            ask: adds what else has to be asked to the dialog; gives what makes the command of the answers.
        """
        with ui.dialog() as dialog, ui.card().classes("ask").props("data-testid=ask"):
            ui.html(f"<h2>{title}?</h2>", sanitize=False)
            ui.label(consequence)
            command = ask()
            with ui.element("div").classes("buttons right"):
                ui.button("Cancel", on_click=dialog.close).props("flat no-caps")

                async def go() -> None:
                    name, parameters = command()
                    dialog.close()
                    await self._send(title, name, parameters)

                ui.button(title, on_click=go, color=None).props("no-caps unelevated data-testid=confirm")
        dialog.open()

    async def _send(self, title: str, name: str, parameters: dict[str, str]) -> None:
        self._tell("", f"{title}: asked, waiting for the robot …")
        result = await run.io_bound(self._session.command, name, parameters)
        if result is not None:  # None: the console ends
            self._tell(result.outcome.value, f"{title}: {WORDS[result.outcome]}. {result.message}")

    def _tell(self, outcome: str, text: str) -> None:
        for label in self._results:
            label.set_text(text)
            label.props(f"data-outcome={outcome or 'waiting'}")


def _selector_value(text: str) -> str:
    """Without what would end a value in a selector."""
    return text.replace(";", ",").replace("&", "and").strip()
