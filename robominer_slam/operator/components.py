"""The page's own parts, each a small JavaScript module in `static/`, as elements of NiceGUI.

The scene is drawn by three.js, which NiceGUI brings: no other copy, nothing from elsewhere at run time.
"""

from __future__ import annotations

from pathlib import Path

import nicegui
from nicegui.element import Element

STATIC = Path(__file__).parent / "static"
_MODULES = {
    "nicegui-scene": str(Path(nicegui.__file__).parent / "elements" / "scene" / "dist"),
    "robominer-console": str(STATIC),
}


class MapView(Element, component="static/map_view.js", esm=_MODULES):
    """The map, with its tools.

    Events:
        place: {"tool", "x", "y", "yaw"}: a place (m) and heading (rad, or None) shown on the map.
    """


class WhiskerPanel(Element, component="static/whisker_panel.js", esm=_MODULES):
    """The array as it is mounted.

    Events:
        choose: {"index"}: a whisker was chosen.
    """


class TimeLine(Element, component="static/time_line.js", esm=_MODULES):
    """The session's time.

    Events:
        seek: {"stamp"}: the moment looked at, UNIX ms; None: now.
    """


class ReadOuts(Element, component="static/read_outs.js", esm=_MODULES):
    """Writes figures into the elements that name them by `data-field`; not seen itself."""


class Keyboard(Element, component="static/keyboard.js", esm=_MODULES):
    """Keys for the map and the time line; not seen itself.

    Events:
        key: {"key"}: one that is not theirs.
    """
