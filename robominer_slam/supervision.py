"""The daemon under systemd: ready when poses flow, watched by its progress, reloaded on request.

Not a timer but work feeds the watchdog: frames that were processed and published since the last look. Where there is
nothing to process, because no device sends whiskers' readings or what they send is refused and counted, a turn of the
loop is enough: to start anew would not make a silent sensor speak. A device that streams while no frame comes out is
our own hang.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

from robominer_slam.configuration.model import Configuration
from robominer_slam.configuration.reload import Reload
from robominer_slam.notify import Notifier
from robominer_slam.status_words import StatusWords

#: How long the start may stall between two turns of the loop: 30 of them.
START_STALL_S = 30.0
#: Figures alone are not told more often: every message wakes systemd and whoever looks at it.
FIGURES_INTERVAL_S = 10.0


class Progress(NamedTuple):
    """What has been done so far.

    Attributes:
        done: frames processed and published (role `drivers`: measurements passed on).
        refused: frames that came and could not be used.
        idle: whether nothing comes that could be processed.
    """

    done: int
    refused: int
    idle: bool


class Supervision:
    """Tells systemd how the daemon does. Without systemd it only reloads."""

    def __init__(self, notifier: Notifier, reload: Reload) -> None:
        self._notifier = notifier
        self._reload = reload
        self._ready = False
        self._last = Progress(0, 0, True)
        self._rate_s, self._rate_done = time.monotonic(), 0
        self._told: StatusWords | None = None
        self._told_s = 0.0

    def turn(self, progress: Progress, words: StatusWords, apply: Callable[[Configuration], None]) -> None:
        """One turn of the main loop, about once a second.

        Args:
            progress: since the start.
            words: what `systemctl status` is to say.
            apply: takes a changed configuration into use.
        """
        if not self._ready and progress.done:
            self._notifier.ready()
            self._ready = True
        elif not self._ready:
            self._notifier.starting(START_STALL_S)
        if progress.done > self._last.done or progress.refused > self._last.refused or progress.idle:
            self._notifier.alive()
        self._last = progress
        self._tell(words)
        if self._reload.wanted:
            self._read_anew(apply)

    def rate_hz(self, done: int) -> float:
        """Frames a second since this was asked last."""
        now = time.monotonic()
        rate = (done - self._rate_done) / max(now - self._rate_s, 1e-3)
        self._rate_s, self._rate_done = now, done
        return rate

    def stopping(self) -> None:
        """The end has begun."""
        self._notifier.stopping()
        self._notifier.status("storing the map")

    def _tell(self, words: StatusWords) -> None:
        now = time.monotonic()
        same = self._told is not None and words[:2] == self._told[:2]
        if words == self._told or (same and now - self._told_s < FIGURES_INTERVAL_S):
            return
        self._notifier.status(str(words))
        self._told, self._told_s = words, now

    def _read_anew(self, apply: Callable[[Configuration], None]) -> None:
        # Before READY there is no reload for systemd, and READY after it would be a lie.
        if self._ready:
            self._notifier.reloading()
        changed = self._reload.read()
        if changed is not None:
            apply(changed)
        if self._ready:
            self._notifier.ready()
