"""The daemon from its first instruction to READY, counted: `counted_start.py CONFIG`, on the emulated board."""

from __future__ import annotations

import os
import signal
import sys

import stages

from robominer_slam import notify
from robominer_slam.cli.main import main

_ready = notify.Notifier.ready


def _at_ready(notifier: notify.Notifier) -> None:
    stages.begin("end")
    _ready(notifier)
    os.kill(os.getpid(), signal.SIGTERM)


# What is counted is the program as it is, up to this call: there is no other place to stand.
notify.Notifier.ready = _at_ready  # type: ignore[method-assign]
sys.argv = ["robominer-slam", "run", "--config", sys.argv[1]]
stages.begin("start")
main()
