"""What systemd is told: readiness, status, life signs; sd_notify(3), one datagram a message.

Written out here because the protocol is a dozen lines: `sdnotify` has had no release since 2017 and knows neither
reloading nor time-outs, `systemd-python` and `cysystemd` need a compiler on the board.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Mapping

log = logging.getLogger(__name__)

#: systemd may be busy for a moment; the main loop must not wait for it for long.
SEND_TIMEOUT_S = 0.2


class Notifier:
    """Sends to the socket that systemd names in the environment; does nothing where there is none.

    Attributes:
        watched: whether systemd expects life signs (`WatchdogSec=`).
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):
            self._address = "\0" + self._address[1:]
        meant = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watched = bool(self._address) and meant and environment.get("WATCHDOG_USEC", "0") != "0"
        self._socket: socket.socket | None = None
        self._failing = False
        if self._address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.settimeout(SEND_TIMEOUT_S)

    def close(self) -> None:
        """Close the socket; nothing is sent after that."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def ready(self) -> None:
        """The service does its work; also after a reload."""
        self._send("READY=1")

    def status(self, text: str) -> None:
        """One line in words for `systemctl status`."""
        self._send("STATUS=" + " ".join(text.split()))

    def alive(self) -> None:
        """Feed the watchdog."""
        if self.watched:
            self._send("WATCHDOG=1")

    def starting(self, seconds: float) -> None:
        """The start goes on for up to so long from now: what is waited for is not ours to hasten."""
        self._send(f"EXTEND_TIMEOUT_USEC={int(seconds * 1e6)}")

    def reloading(self) -> None:
        """The configuration is read anew; `ready` ends it. The stamp is what Type=notify-reload asks for."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """The end has begun."""
        self._send("STOPPING=1")

    def _send(self, message: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(message.encode(), self._address)
            self._failing = False
        except OSError as error:
            # The robot works on whether or not somebody listens; a watchdog that is not fed says the rest.
            if not self._failing:
                log.warning("systemd cannot be told %s: %s", message.split("=")[0], error)
            self._failing = True
