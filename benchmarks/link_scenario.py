"""One run over the slow link: a robot and an operator in their namespaces, and outages between them."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.link_namespaces import ROBOT, Link
from robominer_slam.security.authority import Authority

PORT = 7448
START_S, END_S = 60.0, 20.0

#: Seconds up, then seconds down.
Outages = Sequence[tuple[float, float]]


@dataclass(slots=True)
class Result:
    """What a run showed.

    Attributes:
        seconds: how long the operator was there.
        lateness: of poses (`telemetry` and `pose`), from their stamp to their arrival, s.
        messages, payload: by key.
        kbit_down, kbit_up: on the wire, with all headers.
        joined_s: from the operator's start to a map equal to the robot's; None: never.
        heard_s, equal_s: after each outage, from the link's return to the first pose and to an equal map.
        equal: whether the digest was the robot's at the end, at the same version.
        map_bytes: answers to queries.
        resident_mb: of the robot's process, once a second.
        down_mb: the same at the beginning and the end of the longest outage.
    """

    seconds: float
    lateness: np.ndarray[Any, np.dtype[np.float64]]
    messages: dict[str, int]
    payload: dict[str, int]
    kbit_down: float = 0.0
    kbit_up: float = 0.0
    joined_s: float | None = None
    heard_s: list[float] = field(default_factory=list)
    equal_s: list[float] = field(default_factory=list)
    equal: bool = False
    map_bytes: int = 0
    resident_mb: list[float] = field(default_factory=list)
    down_mb: tuple[float, float] = (0.0, 0.0)

    def late(self, percent: float) -> float:
        """Percentile of the lateness, s."""
        return float(np.percentile(self.lateness, percent)) if len(self.lateness) else float("nan")


class Scenario:
    """Makes keys and runs."""

    def __init__(self, folder: Path, link: Link) -> None:
        self._folder = folder
        self._link = link
        self._authority = Authority.create(folder / "keys")
        self._authority.issue("rm3", "robot", 30, (ROBOT,))
        self._authority.issue("alice", "operator")

    @property
    def robot_bundle(self) -> Path:
        """The robot's keys."""
        return self._authority.bundle("rm3")

    def synthetic(self, *arguments: str) -> list[str]:
        """The command of a robot without SLAM."""
        where = ["--listen", f"tls/{ROBOT}:{PORT}", "--credentials", str(self.robot_bundle)]
        return [sys.executable, "-m", "benchmarks.link_robot", *where, *arguments]

    def run(self, robot: list[str], outages: Outages, *, settle_s: float, ready: str = '"ready"') -> Result:
        """Start both, let the link fail, and see.

        Args:
            robot: command of the robot; its output says `ready` when it listens.
            outages: seconds up and down, one after the other.
            settle_s: up at the end.
            ready: in the robot's output.
        """
        with self._process(self._link.robot, robot, "robot.log") as machine:
            _wait_for(self._folder / "robot.log", ready, machine)
            before, begun = self._link.traffic(), time.time()
            command = [
                sys.executable, "-m", "benchmarks.link_operator", "--connect", f"tls/{ROBOT}:{PORT}",
                "--credentials", str(self._authority.bundle("alice")),
            ]  # fmt: skip
            resident: list[float] = []
            returns: list[float] = []
            longest, down_mb = 0.0, (0.0, 0.0)
            with self._process(self._link.operator, command, "operator.log") as operator:
                for up_s, down_s in outages:
                    _watch(machine, operator, up_s, resident)
                    self._link.cut()
                    cut = resident[-1]
                    try:
                        _watch(machine, operator, down_s, resident)
                        if down_s > longest:
                            longest, down_mb = down_s, (cut, resident[-1])
                    finally:
                        self._link.mend()
                    returns.append(time.time())
                _watch(machine, operator, settle_s, resident)
                seconds, after = time.time() - begun, self._link.traffic()
                # The map stands still, and the robot says at once what it is.
                _tell(operator)
                time.sleep(3.0)
        result = summary(_lines(self._folder / "operator.log"), begun, returns)
        result.seconds, result.resident_mb, result.down_mb = seconds, resident, down_mb
        result.kbit_down = (after.to_operator - before.to_operator) * 8e-3 / seconds
        result.kbit_up = (after.to_robot - before.to_robot) * 8e-3 / seconds
        return result

    @contextmanager
    def _process(self, namespace: str, command: list[str], log: str) -> Iterator[subprocess.Popen[bytes]]:
        with (self._folder / log).open("wb") as file:
            inside = self._link.inside(namespace, command)
            process = subprocess.Popen(inside, stdin=subprocess.PIPE, stdout=file, stderr=subprocess.STDOUT)
        try:
            yield process
        finally:
            assert process.stdin is not None
            process.stdin.close()
            if log == "robot.log":
                process.terminate()
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def summary(lines: list[dict[str, Any]], begun: float, returns: list[float]) -> Result:
    """What an operator's log says."""
    received = [line for line in lines if "key" in line]
    states = [line for line in lines if "synchronised" in line]
    keys = sorted({str(line["key"]) for line in received})
    poses = [line for line in received if line["late"] is not None]
    result = Result(
        0.0,
        np.array([float(line["late"]) for line in poses]),
        {key: sum(line["key"] == key for line in received) for key in keys},
        {key: sum(int(line["bytes"]) for line in received if line["key"] == key) for key in keys},
    )
    result.joined_s = next((line["t"] - begun for line in states if line["synchronised"]), None)
    for index, back in enumerate(returns):
        end = returns[index + 1] if index + 1 < len(returns) else float("inf")
        new = [line for line in poses if back < line["t"] - line["late"] and line["t"] < end]
        if new:
            result.heard_s.append(new[0]["t"] - back)
        # What the robot's map is, telemetry tells; before, the copy is equal only to what the map was.
        told = next((line["t"] for line in new if line["key"] == "telemetry"), end)
        equal = next((line["t"] for line in states if told < line["t"] < end and line["synchronised"]), None)
        if equal is not None:
            result.equal_s.append(equal - back)
    digests = {line["robot_version"]: line["robot_digest"] for line in received if "robot_version" in line}
    last = states[-1] if states else {"version": 0, "digest": None, "counters": {}}
    result.equal = last["digest"] is not None and digests.get(str(last["version"])) == last["digest"]
    result.map_bytes = int(last["counters"].get("reply_bytes", 0))
    return result


def _watch(
    machine: subprocess.Popen[bytes], operator: subprocess.Popen[bytes], seconds: float, resident: list[float]
) -> None:
    """Wait, and look once a second at the robot's memory and whether both still live."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0.0:
        time.sleep(min(1.0, left))
        for name, process in (("robot", machine), ("operator", operator)):
            if process.poll() is not None:
                raise RuntimeError(f"the {name}'s process has ended: see its log")
        status = Path(f"/proc/{machine.pid}/status").read_text(encoding="ascii")
        resident += [int(line.split()[1]) / 1024.0 for line in status.splitlines() if line.startswith("VmRSS")]


def _tell(operator: subprocess.Popen[bytes]) -> None:
    assert operator.stdin is not None
    operator.stdin.write(b"pause\n")
    operator.stdin.flush()


def _wait_for(path: Path, text: str, process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + START_S
    while text not in path.read_text():
        if process.poll() is not None or time.monotonic() > end:
            raise RuntimeError(f"the robot did not start: {path.read_text()[-400:]}")
        time.sleep(0.05)


def _lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines() if line.startswith("{")]
