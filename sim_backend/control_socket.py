"""Control channel of a running simulation: the Unix socket `control` in its folder, lines out, lines back."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

log = logging.getLogger(__name__)

CONTROL = "control"
#: A longer line is no request: whoever sends it is cut off, bytes.
LONGEST_LINE = 4096
#: How long a client waits for its reply, s.
PATIENCE = 10.0


class NoSimulationError(OSError):
    """Nothing answers in that folder; one line says so."""


@contextlib.contextmanager
def _address(folder: Path) -> Iterator[str]:
    """An address of the folder's socket that is short: those of sockets end after 107 bytes, paths do not."""
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{opened}/{CONTROL}"
    finally:
        os.close(opened)


class ControlSocket:
    """The simulation's side: never waits, so that the loop which serves the devices can serve it as well."""

    def __init__(self, folder: Path, answer: Callable[[bytes], bytes]) -> None:
        """Listen in a folder.

        Args:
            folder: where the socket is made; one that a killed simulation left there is replaced.
            answer: makes the reply to a line, with its line feed.

        Raises:
            OSError: the socket cannot be made.
        """
        self._path, self._answer = folder / CONTROL, answer
        self._path.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._clients: dict[socket.socket, bytearray] = {}
        try:
            with _address(folder) as address:
                self._listener.bind(address)
            # Others on this machine drive no robot of ours.
            self._path.chmod(0o600)
            self._listener.listen()
            self._listener.setblocking(False)
        except OSError:
            self._listener.close()
            raise

    def sockets(self) -> list[socket.socket]:
        """What `serve` wants to be called for when it can be read."""
        return [self._listener, *self._clients]

    def serve(self, readable: Collection[object]) -> None:
        """Take new clients, and answer the lines of those that have sent any."""
        if self._listener in readable:
            with contextlib.suppress(BlockingIOError):
                client, _ = self._listener.accept()
                client.setblocking(False)
                self._clients[client] = bytearray()
        for client in [client for client in self._clients if client in readable]:
            try:
                self._receive(client)
            except OSError as error:  # it went away, or does not read its replies
                log.info("a client of the control channel was cut off: %s", error)
                self._drop(client)

    def _receive(self, client: socket.socket) -> None:
        received = client.recv(LONGEST_LINE)
        buffer = self._clients[client]
        buffer += received
        while (end := buffer.find(b"\n")) >= 0:
            reply = self._answer(bytes(buffer[:end]))
            del buffer[: end + 1]
            client.sendall(reply)
        if not received or len(buffer) > LONGEST_LINE:
            self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        del self._clients[client]
        client.close()

    def close(self) -> None:
        """Hang up, and remove the socket."""
        for client in list(self._clients):
            self._drop(client)
        self._listener.close()
        self._path.unlink(missing_ok=True)


def ask(folder: Path, line: bytes) -> bytes:
    """Send one request to the simulation in a folder and return the reply, both lines without line feed.

    Raises:
        NoSimulationError: no simulation runs there, or it does not answer.
    """
    try:
        with _address(folder) as address, socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as channel:
            channel.settimeout(PATIENCE)
            channel.connect(address)
            channel.sendall(line + b"\n")
            with channel.makefile("rb") as replies:
                reply = replies.readline(LONGEST_LINE)
    except TimeoutError as error:
        raise NoSimulationError(f"{folder}: the simulation there does not answer") from error
    except OSError as error:
        raise NoSimulationError(f"{folder}: no simulation runs there, start `simulate --out {folder}`") from error
    if not reply.endswith(b"\n"):
        raise NoSimulationError(f"{folder}: the simulation there ended before it answered")
    return reply[:-1]
