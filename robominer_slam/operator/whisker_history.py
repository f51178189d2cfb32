"""One whisker's last minute as a chart."""

from __future__ import annotations

import time

import numpy as np
from nicegui import ui

from robominer_slam.operator.robot_view import RobotView

SECONDS = 60.0
REFRESH_S = 0.5
#: Colours of Okabe and Ito.
_INCLINATION, _AZIMUTH = "#e69f00", "#56b4e9"


class WhiskerHistory:
    """A dialog that follows one whisker while it is open."""

    def __init__(self, view: RobotView) -> None:
        self._view = view
        self._index = 0
        with ui.dialog().props("seamless position=bottom") as self._dialog, ui.card().classes("history"):
            with ui.element("div").classes("history-head"):
                self._title = ui.label().props("data-testid=history-title")
                ui.button("Close", on_click=self.hide).props("flat dense no-caps")
            self._chart = ui.echart(_options()).classes("history-chart").props("data-testid=history")
        self._timer = ui.timer(REFRESH_S, self._refresh, active=False)

    def show(self, index: int) -> None:
        """Follow a whisker."""
        self._index = index
        layout = self._view.layout
        cols = layout.cols if layout is not None else 1
        self._title.set_text(f"Whisker in row {index // cols}, column {index % cols}: the last {SECONDS:.0f} s")
        self._dialog.open()
        self._timer.activate()
        self._refresh()

    def hide(self) -> None:
        """Follow none."""
        self._timer.deactivate()
        self._dialog.close()

    def _refresh(self) -> None:
        with self._view.lock:
            span = self._view.history.span_ns
            end = time.time_ns() if self._view.progress is None else (span or (0, 0))[1]
            values = self._view.history.whisker(self._index, end, SECONDS)
        degrees = np.round(np.rad2deg(values[:, 1:]), 1)
        for k, series in enumerate(self._chart.options["series"]):
            bent = values[:, 1] > 0.0 if k else np.isfinite(values[:, 1])
            series["data"] = [
                [round(float(t), 2), float(value) if ok else None]
                for t, value, ok in zip(values[:, 0], degrees[:, k], bent, strict=True)
            ]
        self._chart.update()


def _options() -> dict[str, object]:
    axis = {
        "nameLocation": "middle",
        "nameGap": 34,
        "axisLabel": {"color": "#8a98a6"},
        "nameTextStyle": {"color": "#8a98a6"},
        "splitLine": {"lineStyle": {"color": "#8a98a640"}},
    }
    line = {"type": "line", "showSymbol": False, "connectNulls": False, "data": []}
    return {
        "animation": False,
        "grid": {"left": 60, "right": 60, "top": 34, "bottom": 44},
        "legend": {"top": 0, "textStyle": {"color": "#8a98a6"}},
        "tooltip": {"trigger": "axis"},
        "xAxis": {"type": "value", "min": -SECONDS, "max": 0, "name": "time (s)", **axis, "nameGap": 26},
        "yAxis": [
            {"type": "value", "min": 0, "max": 90, "interval": 30, "name": "inclination (°)", **axis},
            {
                "type": "value",
                "min": -180,
                "max": 180,
                "interval": 90,
                "name": "azimuth (°)",
                **axis,
                "splitLine": {"show": False},
            },
        ],
        "series": [
            {**line, "name": "inclination", "color": _INCLINATION, "step": "end"},
            {"type": "scatter", "symbolSize": 3, "data": [], "name": "azimuth", "color": _AZIMUTH, "yAxisIndex": 1},
        ],
    }
