"""A pseudo-terminal that looks like a serial port with a stable name."""

from __future__ import annotations

import fcntl
import os
import pty
import struct
import termios
import tty
from pathlib import Path


class PseudoTerminal:
    """The device's end of a pseudo-terminal; the host opens `path`.

    Attributes:
        path: the port's name, a symbolic link to the terminal.
        dropped: packets that nobody took.
        plugged: whether the port exists; False once it is closed.
    """

    def __init__(self, path: Path) -> None:
        """Create the terminal and its link.

        Raises:
            OSError: the link cannot be made.
        """
        self.path = path
        self.dropped = 0
        self.plugged = True
        self._master, self._slave = pty.openpty()
        # This end keeps the host's end open too, or reading would fail whenever no host is there.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._rest = b""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(self._slave))

    def fileno(self) -> int:
        """For `select`."""
        return self._master

    def write(self, packet: bytes) -> bool:
        """Send a packet whole or not at all; False, and counted, where the host does not read."""
        if self._rest:
            self._rest = self._rest[self._put(self._rest) :]
        if self._rest:
            self.dropped += 1
            return False
        written = self._put(packet)
        if written == 0:
            self.dropped += 1
            return False
        # A packet that has begun is finished later, so that the host never sees half of one.
        self._rest = packet[written:]
        return True

    def read(self) -> bytes:
        """What the host has sent; empty if nothing."""
        try:
            return os.read(self._master, 4096)
        except BlockingIOError:
            return b""

    def unread(self) -> int:
        """Bytes that the host has not read yet."""
        waiting: int = struct.unpack("i", fcntl.ioctl(self._slave, termios.FIONREAD, b"\0\0\0\0"))[0]
        return waiting

    def close(self) -> None:
        """Unplug: the host's end fails from now on, and the name is gone."""
        self.plugged = False
        self.path.unlink(missing_ok=True)
        os.close(self._master)
        os.close(self._slave)

    def _put(self, data: bytes) -> int:
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0
