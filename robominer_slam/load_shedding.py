"""What the daemon leaves undone when it cannot keep up: map detail first, then loop search, then matching; never poses.

A board that is busy, hot or slow shows by one of two things: poses leave late, or the back-end's results come late.
While either lasts, one more step is left out each second; when neither has been seen for a while, the last one
returns. What was left out is not made up for: the next pass over the same ground finds the loop.
"""

from __future__ import annotations

import logging
from enum import IntEnum

from robominer_slam.configuration.load_section import LoadSection

log = logging.getLogger(__name__)

#: Where poses are this share of the limit late, or less, all is well again.
WELL = 0.5


class Shed(IntEnum):
    """How much is left undone; each level includes those before it."""

    NOTHING = 0
    MAP_DETAIL = 1
    LOOP_SEARCH = 2
    MATCHING = 3


WORDS = {
    Shed.NOTHING: "keeps up",
    Shed.MAP_DETAIL: "left out: map detail (changes are published every 5 s, contacts five times a second)",
    Shed.LOOP_SEARCH: "left out: map detail, loop search",
    Shed.MATCHING: "left out: map detail, loop search, matching with the ground touched lately",
}


class LoadShedding:
    """Decides from how late things are.

    Attributes:
        level: what is left undone now.
        lag_s: the worst of the last second: from a frame's first sensor to its pose on the bus.
        behind_s: likewise, by how much the back-end's results were late.
        times: how often something more was left out.
    """

    def __init__(self, section: LoadSection) -> None:
        self._section = section
        self.level = Shed.NOTHING
        self.lag_s = self.behind_s = 0.0
        self.times = 0
        self._lag_s = self._behind_s = 0.0
        self._well_since_s: float | None = None

    def frame(self, lag_s: float, behind_s: float) -> None:
        """A frame's pose has left; how late it is, and how late the back-end."""
        self._lag_s, self._behind_s = max(self._lag_s, lag_s), max(self._behind_s, behind_s)

    def turn(self, now_s: float) -> Shed:
        """Once a second, by the monotonic clock: what is to be left undone from now on."""
        section = self._section
        self.lag_s, self.behind_s = self._lag_s, self._behind_s
        self._lag_s = self._behind_s = 0.0
        late = max(self.lag_s / section.max_lag, self.behind_s / section.max_behind)
        if late > 1.0:
            self._well_since_s = None
            if self.level < Shed.MATCHING:
                self._set(Shed(self.level + 1))
                self.times += 1
        elif late > WELL or self._well_since_s is None:
            self._well_since_s = now_s
        elif self.level > Shed.NOTHING and now_s - self._well_since_s >= section.recovery:
            self._set(Shed(self.level - 1))
            self._well_since_s = now_s
        return self.level

    def _set(self, level: Shed) -> None:
        log.log(
            logging.WARNING if level > self.level else logging.INFO,
            "load: poses %.2f s late at most, the back-end %.1f s: %s",
            self.lag_s, self.behind_s, WORDS[level],
        )  # fmt: skip
        self.level = level
