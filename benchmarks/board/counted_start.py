"""The daemon from its first instruction to READY, counted: `counted_start.py CONFIG`, on the emulated board.

READY is told as it is to systemd, on the socket that the environment names; here a thread of the same process listens,
since the counter knows which stage a process is in, and ends the daemon then.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import tempfile
import threading
from pathlib import Path

import stages

from robominer_slam.cli.main import main


def end_when_ready(told: socket.socket) -> None:
    """Wait for READY; the count ends with it."""
    while told.recv(4096) != b"READY=1":
        pass
    stages.begin("end")
    os.kill(os.getpid(), signal.SIGTERM)


with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told:
    path = Path(folder) / "notify"
    told.bind(str(path))
    os.environ["NOTIFY_SOCKET"] = str(path)
    threading.Thread(target=end_when_ready, args=(told,), name="ready", daemon=True).start()
    sys.argv = ["robominer-slam", "run", "--config", sys.argv[1]]
    stages.begin("start")
    main()
