"""Section `[load]`: when the daemon leaves work undone to keep up with the robot."""

from __future__ import annotations

from robominer_slam.configuration.parameter import Section, parameter


class LoadSection(Section):
    """A board that is too busy, too hot or too slow."""

    max_lag: float = parameter(
        0.3, "s", "from a frame's first sensor to its pose; reading the array takes 0.04 s, waiting for its turn 0.06",
        low=0.05, high=60.0,
    )  # fmt: skip
    max_behind: float = parameter(
        2.0, "s", "the back-end's results late by this: three keyframes at 0.15 m/s", low=0.1, high=600.0
    )
    recovery: float = parameter(10.0, "s", "in time again before something is taken up again", low=1.0, high=3600.0)
