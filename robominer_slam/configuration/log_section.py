"""Section `[log]`: what the daemon writes to the journal, or to stderr."""

from __future__ import annotations

from typing import Literal

from robominer_slam.configuration.parameter import Section, parameter


class LogSection(Section):
    """The log."""

    level: Literal["debug", "info", "warning", "error"] = parameter(
        "info", "", "what is less is left out; --verbose has the last word"
    )
    repeats: int = parameter(
        10, "1", "so many lines in a period from one place on one device: a plug that flaps must not fill the journal",
        low=1, high=100_000,
    )  # fmt: skip
    repeats_period: float = parameter(60.0, "s", "after it a place may speak again", low=0.1, high=86_400.0)
