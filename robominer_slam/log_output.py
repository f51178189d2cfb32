"""The daemon's log: to the journal with levels and fields, elsewhere as lines on stderr; repeats are held back."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Mapping

from robominer_slam.configuration.log_section import LogSection
from robominer_slam.journal import JournalHandler, stderr_is_journal

#: So many places are remembered; a program has fewer, unless what they speak of is ever new.
MOST_PLACES = 1000


class RepeatLimit(logging.Filter):
    """Lets a place in the program speak so often in a period; one place may speak of many devices, each by itself."""

    def __init__(self, repeats: int, period_s: float) -> None:
        super().__init__()
        self.repeats, self.period_s = repeats, period_s
        #: By place: when its period began, how many were let through, how many were held back.
        self._places: dict[tuple[str, int, str], tuple[float, int, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a record is let through; one that is the last, or the first again, says so."""
        first = record.args[0] if isinstance(record.args, tuple) and record.args else ""
        place = (record.pathname, record.lineno, first if isinstance(first, str) else "")
        now = time.monotonic()
        began, passed, held = self._places.get(place, (now, 0, 0))
        remark = ""
        if now - began >= self.period_s:
            began, passed = now, 0
        if passed >= self.repeats:
            self._places[place] = (began, passed, held + 1)
            return False
        if held:
            remark = f" ({held} like this were left out)"
        if passed + 1 == self.repeats:
            remark += f" (more like this within {self.period_s:g} s will be left out)"
        record.__dict__["remark"] = remark
        self._places.pop(place, None)
        if len(self._places) >= MOST_PLACES:
            self._places.pop(next(iter(self._places)))
        self._places[place] = (began, passed + 1, 0)
        return True


class LogOutput:
    """Where the daemon's log goes; takes the place of what was there before."""

    def __init__(self, section: LogSection, verbose: bool, environment: Mapping[str, str] = os.environ) -> None:
        self._verbose = verbose
        self._limit = RepeatLimit(section.repeats, section.repeats_period)
        handler: logging.Handler = logging.StreamHandler(sys.stderr)
        if stderr_is_journal(environment):
            handler = JournalHandler()
        handler.setFormatter(
            logging.Formatter("%(levelname)s %(name)s: %(message)s%(remark)s", defaults={"remark": ""})
        )
        handler.addFilter(self._limit)
        root = logging.getLogger()
        root.handlers[:] = [handler]
        self.configure(section)

    def configure(self, section: LogSection) -> None:
        """Take a section into use."""
        self._limit.repeats, self._limit.period_s = section.repeats, section.repeats_period
        level = logging.DEBUG if self._verbose else logging.getLevelNamesMapping()[section.level.upper()]
        logging.getLogger().setLevel(level)
