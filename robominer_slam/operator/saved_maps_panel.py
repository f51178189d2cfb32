"""The list of saved maps on a page: when they were begun, how large they are, and files to save them as."""

from __future__ import annotations

from datetime import UTC, datetime

from nicegui import run, ui

from robominer_slam.operator.saved_maps import FORMATS, SavedMapEntry
from robominer_slam.operator.session import Session
from robominer_slam.publishing.bus_messages import QueryError


class SavedMapsPanel:
    """The list; empty until it is asked for, and never asked for by itself: the link may be slow."""

    def __init__(self, session: Session) -> None:
        self._session = session
        with ui.element("div").classes("buttons"):
            ui.button("List", on_click=self.refresh, color=None).props("no-caps unelevated data-testid=list-maps")
        self._told = ui.label("").props("role=status data-testid=maps-told")
        self._list = ui.element("ul").classes("list").props('data-testid=saved-maps aria-label="Saved maps"')
        self._list.set_visibility(False)

    async def refresh(self) -> None:
        """Ask the robot, and show what it says."""
        self._told.set_text("asked, waiting for the robot …")
        maps, fault = await run.io_bound(self._ask) or ([], "")
        self._told.set_text(fault or ("" if maps else "no map is saved yet"))
        self._list.set_visibility(bool(maps))
        self._list.clear()
        with self._list:
            for entry in maps:
                self._row(entry)

    def _ask(self) -> tuple[list[SavedMapEntry], str]:
        try:
            return self._session.saved_maps(), ""
        except QueryError as error:
            return [], f"not answered: {error}"

    def _row(self, entry: SavedMapEntry) -> None:
        begun = datetime.fromtimestamp(entry.created_unix_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M UTC")
        with ui.element("li").props(f"data-map={entry.number}"), ui.element("div").classes("saved-map"):
            name = entry.name or f"map {entry.number}"
            ui.label(f"{name} (present)" if entry.present else name).classes("saved-map-name")
            ui.label(f"begun {begun}, {entry.keyframes:,} keyframes")
            with ui.element("div").classes("buttons"):
                for ending in FORMATS:
                    ui.link(ending.upper(), f"/saved/{entry.number}.{ending}").classes("button-link").props("download")
