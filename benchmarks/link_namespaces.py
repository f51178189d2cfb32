"""Two network namespaces with a slow radio between them that can be cut; needs root and iproute2.

    robot (10.73.0.1) --veth-- radio (a bridge, limits each way) --veth-- operator (10.73.0.2)

The radio has a namespace of its own, so that neither end sees a cable pulled: packets vanish, as in the air. A small
buffer stands before each way; what does not fit is dropped.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import dataclass
from types import TracebackType

ROBOT, OPERATOR = "10.73.0.1", "10.73.0.2"
#: Time that a full buffer of the radio takes to empty, ms.
BUFFER_MS = 300
#: The bucket has to take the largest packet, bytes.
BURST_BYTES = 1600


class NamespacesError(Exception):
    """Why there can be no namespaces here; one line."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """Bytes on the wire since the beginning, with all headers from Ethernet up."""

    to_operator: int
    to_robot: int


def why_not() -> str:
    """Why there can be no namespaces here; empty where there can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None or shutil.which("tc") is None:
        return "network namespaces need `ip` and `tc`: apt-get install -y iproute2"
    return ""


class Link:
    """The namespaces, made and taken away; use it with `with`."""

    def __init__(self, kbit_per_s: float | None = 64.0) -> None:
        """Make them.

        Args:
            kbit_per_s: rate of each way; None: no limit.

        Raises:
            NamespacesError: not root, no iproute2, or a kernel without what is needed.
        """
        if missing := why_not():
            raise NamespacesError(missing)
        tag = f"rms{os.getpid() % 100_000}"
        self.robot, self._radio, self.operator = f"{tag}r", f"{tag}x", f"{tag}o"
        try:
            for name in (self.robot, self._radio, self.operator):
                _run("ip", "netns", "add", name)
                _run("ip", "-n", name, "link", "set", "lo", "up")
            _run("ip", "-n", self._radio, "link", "add", "bridge", "type", "bridge")
            for name, end, address in ((self.robot, "robot", ROBOT), (self.operator, "operator", OPERATOR)):
                self._join(name, end, address, kbit_per_s)
            _run("ip", "-n", self._radio, "link", "set", "bridge", "up")
        except NamespacesError:
            self.close()
            raise

    def __enter__(self) -> Link:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Take them away; processes in them must have ended."""
        for name in (self.robot, self._radio, self.operator):
            # One that was not made is no matter.
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)

    @staticmethod
    def inside(name: str, command: list[str]) -> list[str]:
        """A command line that runs a command in a namespace."""
        return ["ip", "netns", "exec", name, *command]

    def cut(self) -> None:
        """Set the radio's link down."""
        _run("ip", "-n", self._radio, "link", "set", "operator", "down")

    def mend(self) -> None:
        """Set it up again."""
        _run("ip", "-n", self._radio, "link", "set", "operator", "up")

    def traffic(self) -> Traffic:
        """What has gone through the radio."""
        return Traffic(self._bytes("operator", "tx"), self._bytes("robot", "tx"))

    def _join(self, name: str, end: str, address: str, kbit_per_s: float | None) -> None:
        _run("ip", "link", "add", "radio", "netns", name, "type", "veth", "peer", "name", end, "netns", self._radio)
        _run("ip", "-n", name, "address", "add", f"{address}/24", "dev", "radio")
        _run("ip", "-n", name, "link", "set", "radio", "up")
        _run("ip", "-n", self._radio, "link", "set", end, "master", "bridge", "up")
        if kbit_per_s is not None:
            shape = ["rate", f"{kbit_per_s:g}kbit", "burst", str(BURST_BYTES), "latency", f"{BUFFER_MS}ms"]
            _run("tc", "-n", self._radio, "qdisc", "add", "dev", end, "root", "tbf", *shape)

    def _bytes(self, end: str, way: str) -> int:
        path = f"/sys/class/net/{end}/statistics/{way}_bytes"
        return int(_run("ip", "netns", "exec", self._radio, "cat", path))


def _run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        reason = " ".join(done.stderr.split()) or f"exit code {done.returncode}"
        raise NamespacesError(f"{' '.join(command)}: {reason}")
    return done.stdout
