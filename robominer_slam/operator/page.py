"""The page: header, map, panels, time line. Figures are written by the stream; this lays out where they go."""

from __future__ import annotations

from html import escape

from nicegui import events, ui

from robominer_slam.operator.command_panel import CommandPanel
from robominer_slam.operator.components import STATIC, Keyboard, MapView, ReadOuts, TimeLine, WhiskerPanel
from robominer_slam.operator.saved_maps_panel import SavedMapsPanel
from robominer_slam.operator.session import Session
from robominer_slam.operator.whisker_history import WhiskerHistory

KEYS = (
    ("T / P", "from above / in perspective"),
    ("F", "follow the robot or free camera"),
    ("A", "show the whole map"),
    ("arrows, + −", "move, zoom"),
    ("M / H", "measure a distance / a height"),
    ("W", "waypoint (simulated robot)"),
    ("L", "say where the robot is"),
    ("Esc", "put the tool down, clear measurements"),
    ("space", "play the session"),
    (", / .", "a second back / on"),
    ("N", "back to now"),
    ("D", "dark or light"),
)


def build_page(session: Session) -> None:
    """Lay out one page for one visitor."""
    ui.add_css((STATIC / "console.css").read_text(encoding="utf-8"))
    dark = ui.dark_mode(value=True)
    ReadOuts()
    with ui.element("div").classes("console"):
        with ui.element("header").classes("top-bar"):
            keys = _header(session, dark)
        with ui.element("main").classes("stage"):
            map_view = MapView()
            map_view.props["dark"] = True
        with ui.element("aside").classes("side"):
            panel = _side(session)
        with ui.element("footer").classes("bottom-bar"):
            time_line = TimeLine()
    map_view.on("place", lambda event: panel.place(event.args))
    dark.on_value_change(lambda event: _set_dark(map_view, dark=bool(event.value)))
    keyboard = Keyboard()
    keyboard.props["map-id"], keyboard.props["time-id"] = map_view.id, time_line.id
    help_dialog = _help()

    def on_key(event: events.GenericEventArguments) -> None:
        if event.args["key"] == "d":
            dark.toggle()
        else:
            help_dialog.open()

    keyboard.on("key", on_key)
    keys.on_click(help_dialog.open)


def _set_dark(map_view: MapView, *, dark: bool) -> None:
    map_view.props["dark"] = dark
    map_view.update()


def _header(session: Session, dark: ui.dark_mode) -> ui.button:
    ui.html(f"<h1>{escape(session.robot)}</h1>", sanitize=False)
    for name, title in (("state", "Localisation"), ("link", "Link"), ("fault_count", "Faults")):
        with ui.element("div").classes(f"pill pill-{name}").props(f'title="{title}" role=status data-testid={name}'):
            ui.element("i")
            _field(name)
    with ui.element("div").classes("header-figures follows-link"):
        for label, name in (("sure within", "sigma"), ("driven", "driven"), ("latency", "latency")):
            with ui.element("span"):
                ui.label(label)
                _field(name)
    ui.element("div").classes("spring")
    keys = ui.button("Keys", color=None).props("flat dense no-caps").classes("plain")
    ui.button("Dark / light", on_click=dark.toggle, color=None).props("flat dense no-caps").classes("plain")
    return keys


def _field(name: str) -> None:
    ui.element("b").props(f"data-field={name}")


def _figures(rows: tuple[tuple[str, str], ...], follows: str = "link") -> None:
    with ui.element("dl").classes(f"figures follows-{follows}"):
        for label, name in rows:
            with ui.element("dt"):
                ui.label(label)
            ui.element("dd").props(f"data-field={name}")


def _card(title: str) -> ui.element:
    card = ui.element("section").classes("card").props(f'aria-label="{title}"')
    with card:
        ui.html(f"<h2>{title}</h2>", sanitize=False)
    return card


def _side(session: Session) -> CommandPanel:
    with ui.tabs().props("dense no-caps align=justify").classes("side-tabs") as tabs:
        drive, robot, log = ui.tab("Drive"), ui.tab("Robot and link"), ui.tab("Maps and log")
    with ui.tab_panels(tabs, value=drive, keep_alive=True, animated=False).classes("side-panels"):
        with ui.tab_panel(drive):
            with _card("Place"):
                _figures(
                    (("x", "x"), ("y", "y"), ("z", "z"), ("heading", "heading"), ("sure within (1σ)", "sigma"),
                     ("heading (1σ)", "sigma_heading"), ("driven", "driven"), ("whiskers touching", "touching"))
                )  # fmt: skip
            with _card("Whiskers"):
                whiskers = WhiskerPanel()
            with _card("Commands"):
                panel = CommandPanel(session)
                panel.drive_commands()
        with ui.tab_panel(robot):
            with _card("Faults"):
                ui.element("ul").props("id=faults data-testid=faults").classes("list follows-status")
            with _card("Link"):
                _figures(
                    (("last heard", "heard"), ("latency, robot to here", "latency"),
                     ("latency, to this page", "latency_page"),
                     ("poses", "rate_pose"), ("telemetry", "rate_telemetry"), ("whisker frames", "rate_whiskers"),
                     ("this page", "rate_page"), ("bandwidth", "bandwidth"), ("of it the map", "bandwidth_map"),
                     ("received", "received"), ("outages", "outages"))
                )  # fmt: skip
            with _card("Robot's computer"):
                _figures(
                    (("CPU", "cpu"), ("memory", "memory"), ("disk", "disk"), ("map store", "store"),
                     ("clock", "clock"), ("device clocks", "device_clocks")), "status"
                )  # fmt: skip
            with _card("Devices"):
                ui.element("ul").props("id=devices").classes("list follows-status")
        with ui.tab_panel(log):
            with _card("Map"):
                _figures(
                    (("points", "points"), ("keyframes", "keyframes"), ("loop closures", "closures"),
                     ("version", "map_version"), ("number on the robot", "map_id"))
                )  # fmt: skip
                panel.map_commands()
            with _card("Export"):
                _exports()
            with _card("Saved maps"):
                SavedMapsPanel(session)
            with _card("Log"):
                ui.element("ul").props("id=events data-testid=events").classes("list")
    history = WhiskerHistory(session.view)
    whiskers.on("choose", lambda event: history.show(int(event.args["index"])))
    return panel


def _exports() -> None:
    with ui.element("div").classes("buttons"):
        for text, name in (
            ("Map (PLY)", "map.ply"),
            ("Keyframes (TUM)", "keyframes.tum"),
            ("Poses (TUM)", "poses.tum"),
        ):
            ui.link(text, f"/export/{name}").classes("button-link").props("download")


def _help() -> ui.dialog:
    with ui.dialog() as dialog, ui.card().classes("ask"):
        ui.html("<h2>Keys</h2>", sanitize=False)
        rows = "".join(f"<dt>{key}</dt><dd>{text}</dd>" for key, text in KEYS)
        ui.html(f'<dl class="figures keys">{rows}</dl>', sanitize=False)
        ui.button("Close", on_click=dialog.close).props("flat no-caps")
    return dialog
