"""What of a changed configuration takes effect live, and what supervision makes of progress."""

from __future__ import annotations

import logging
import socket
from pathlib import Path

import pytest

from drivers.device import DeviceStatus
from robominer_slam.configuration.file import load
from robominer_slam.configuration.model import Configuration
from robominer_slam.configuration.reload import LIVE, Reload, flat, is_live
from robominer_slam.notify import Notifier
from robominer_slam.status_words import StatusWords, slam_words
from robominer_slam.supervision import Progress, Supervision


def test_every_live_key_exists():
    known = flat(Configuration())
    for section, keys in LIVE.items():
        assert {f"{section}.{key}" for key in keys} <= set(known)
    assert not is_live("zenoh.listen")
    assert not is_live("store.path")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "config.toml"
    path.write_text('[[device]]\nname = "imu"\nport = "auto"\n')
    return path


def reread(file: Path, addition: str, caplog: pytest.LogCaptureFixture) -> Configuration | None:
    reload = Reload(file, load(file))
    file.write_text(file.read_text() + addition)
    with caplog.at_level(logging.INFO):
        return reload.read()


def test_live_keys_are_taken_and_the_others_are_named_and_left(file: Path, caplog: pytest.LogCaptureFixture):
    new = reread(file, "baud = 9600\n[map]\nobstacle_height = 0.1\npoint_voxel = 0.02\n[store]\nsync_s = 5\n", caplog)
    assert new is not None
    assert (new.map.obstacle_height, new.store.sync_s) == (0.1, 5.0)
    assert (new.map.point_voxel, new.device[0].baud) == (0.01, 115200)
    waiting = {r.getMessage().split()[0] for r in caplog.records if "needs a restart" in r.getMessage()}
    assert waiting == {"map.point_voxel", "device.imu.baud"}


def test_what_needs_a_restart_alone_changes_nothing(file: Path, caplog: pytest.LogCaptureFixture):
    assert reread(file, '[robot]\nid = "other"\n', caplog) is None
    assert "robot.id has changed to other: needs a restart" in caplog.text


def test_a_broken_file_leaves_everything(file: Path, caplog: pytest.LogCaptureFixture):
    assert reread(file, "[map]\nobstacle_height = 50\n", caplog) is None
    assert [r.levelname for r in caplog.records] == ["ERROR"]
    assert "map.obstacle_height: expected" in caplog.text


class Watched:
    """A supervision whose life signs are counted."""

    def __init__(self, folder: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(folder / "notify"))
        self.socket.setblocking(False)
        self.notifier = Notifier({"NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": "1000000"})
        self.supervision = Supervision(self.notifier, Reload(folder / "config.toml", Configuration()))

    def turn(self, done: int, refused: int = 0, idle: bool = False, words: str = "tracking") -> list[str]:
        self.supervision.turn(Progress(done, refused, idle), StatusWords(words, ""), lambda _: None)
        heard = []
        while True:
            try:
                heard.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return heard

    def close(self) -> None:
        self.notifier.close()
        self.socket.close()


def test_only_progress_or_its_good_reason_to_be_missing_feeds_the_watchdog(tmp_path: Path):
    watched = Watched(tmp_path)
    try:
        assert watched.turn(1) == ["READY=1", "WATCHDOG=1", "STATUS=tracking"]
        assert watched.turn(2) == ["WATCHDOG=1"]
        # The device streams, the loop turns, and no frame comes out: ours, whatever the reason.
        assert watched.turn(2) == []
        assert watched.turn(2, words="stuck") == ["STATUS=stuck"]
        assert watched.turn(2, refused=1) == ["WATCHDOG=1", "STATUS=tracking"]
        assert watched.turn(2, refused=1) == []
        assert watched.turn(2, refused=1, idle=True) == ["WATCHDOG=1"]
    finally:
        watched.close()


def test_words_before_and_without_frames():
    devices = [DeviceStatus("whiskers", "silent", None, "", {}, 0, 0, 0.0, ""),
               DeviceStatus("imu", "streaming", None, "", {}, 0, 0, 0.0, "")]  # fmt: skip
    assert str(slam_words(None, 0.0, 0, devices)) == (
        "waiting for the first whisker frame; whiskers silent, imu streaming"
    )
    assert str(slam_words(None, 0.0, 0, [])) == "waiting for the first whisker frame; no device heard"
