"""The daemon's log: levels and fields in the journal, and no flood of one line."""

from __future__ import annotations

import io
import logging
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from robominer_slam.configuration.log_section import LogSection
from robominer_slam.journal import JournalHandler, entry
from robominer_slam.log_output import MOST_PLACES, LogOutput, RepeatLimit


def record(
    message: str = "device %s: %s", args: tuple[object, ...] = ("imu", "absent"), line: int = 1
) -> logging.LogRecord:
    return logging.LogRecord("drivers.serial_reader", logging.WARNING, "reader.py", line, message, args, None, "f")


class TestRepeats:
    @pytest.fixture
    def now(self, monkeypatch: pytest.MonkeyPatch) -> list[float]:
        now = [100.0]
        monkeypatch.setattr("robominer_slam.log_output.time.monotonic", lambda: now[0])
        return now

    def test_a_device_that_flaps_is_held_back_and_counted(self, now: list[float]):
        limit = RepeatLimit(3, 60.0)
        passed = [r for r in (record() for _ in range(100)) if limit.filter(r)]
        assert [r.remark for r in passed] == ["", "", " (more like this within 60 s will be left out)"]
        now[0] += 59.0
        assert not limit.filter(record())
        now[0] += 1.0
        after = record()
        assert limit.filter(after)
        assert after.remark == " (98 like this were left out)"

    @pytest.mark.usefixtures("now")
    def test_another_device_and_another_place_are_heard(self):
        limit = RepeatLimit(1, 60.0)
        assert limit.filter(record())
        assert not limit.filter(record())
        assert limit.filter(record(args=("whiskers", "absent")))
        assert limit.filter(record(line=2))

    @pytest.mark.usefixtures("now")
    def test_places_that_are_ever_new_do_not_fill_the_memory(self):
        limit = RepeatLimit(1, 60.0)
        for i in range(3 * MOST_PLACES):
            assert limit.filter(record(args=(str(i), "")))
        assert len(limit._places) == MOST_PLACES


class TestJournal:
    @pytest.fixture
    def journal(self, tmp_path: Path) -> Iterator[socket.socket]:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
            heard.bind(str(tmp_path / "journal"))
            heard.settimeout(5.0)
            yield heard

    def test_an_entry_has_level_and_fields(self, journal: socket.socket, tmp_path: Path):
        handler = JournalHandler(str(tmp_path / "journal"))
        one = record()
        one.device, one.state = "imu", "absent"
        handler.emit(one)
        handler.close()
        fields = dict(line.split(b"=", 1) for line in journal.recv(4096).splitlines())
        assert fields[b"MESSAGE"] == b"device imu: absent"
        assert (fields[b"PRIORITY"], fields[b"DEVICE"], fields[b"STATE"]) == (b"4", b"imu", b"absent")
        assert fields[b"LOGGER"] == b"drivers.serial_reader"

    def test_several_lines_go_as_one_entry(self):
        text = "first\nPRIORITY=0"
        data = entry(record(), text)
        assert data.startswith(b"MESSAGE\n" + struct.pack("<Q", len(text)) + text.encode() + b"\nPRIORITY=4\n")

    def test_without_the_socket_every_line_has_its_level(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        written = io.StringIO()
        monkeypatch.setattr(sys, "stderr", written)
        handler = JournalHandler(str(tmp_path / "nobody"))
        handler.emit(record("two\nlines", ()))
        handler.close()
        assert written.getvalue() == "<4>two\n<4>lines\n"


def test_a_mistake_of_the_user_has_its_level_where_stderr_is_the_journal(tmp_path: Path):
    command = [
        sys.executable,
        "-c",
        "from robominer_slam.cli.main import main; main()",
        "run",
        "--config",
        "absent.toml",
    ]
    for in_journal, start in ((True, "<3>error: "), (False, "error: ")):
        with (tmp_path / "stderr").open("w+") as stderr:
            status = os.fstat(stderr.fileno())
            stream = f"{status.st_dev}:{status.st_ino}" if in_journal else "1:1"
            done = subprocess.run(command, stderr=stderr, env={**os.environ, "JOURNAL_STREAM": stream}, check=False)
            assert done.returncode == 2
            stderr.seek(0)
            assert stderr.read().startswith(start)


def test_levels_follow_the_section_unless_verbose(monkeypatch: pytest.MonkeyPatch):
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    try:
        output = LogOutput(LogSection(level="warning"), verbose=False, environment={})
        assert root.level == logging.WARNING
        output.configure(LogSection(level="error"))
        assert root.level == logging.ERROR
        LogOutput(LogSection(level="error"), verbose=True, environment={})
        assert root.level == logging.DEBUG
    finally:
        root.handlers[:] = before
        root.setLevel(level)
