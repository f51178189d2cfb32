"""The console on links of other kinds: a remote one, one that may only look on, a recording, a simulated robot."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from robominer_slam.configuration.model import ZenohSection
from robominer_slam.publishing.bus_messages import QueryError
from robominer_slam.publishing.robot_settings import robot_settings
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSettings
from robominer_slam.security.authority import Authority
from tests.operator_page import PATIENCE_MS, browser, complaints_of, console, free_port, opened, program, status_of
from tests.published_robot import PublishedRobot

RECORDING = Path(__file__).parent / "recordings"


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    with browser() as started:
        yield started


def pressed(page: Page, button: str) -> Locator:
    """Press a command's button and confirm; where its result is told."""
    page.get_by_test_id(button).click()
    page.get_by_test_id("ask").get_by_test_id("confirm").click()
    return page.get_by_test_id("command-result").first


def test_by_tls_a_viewer_sees_all_and_may_not_command(chromium: Browser, tmp_path: Path):
    authority, port = Authority.create(tmp_path / "keys"), free_port()
    for name, role in (("rm3", "robot"), ("alice", "operator"), ("bob", "viewer")):
        authority.issue(name, role)
    section = ZenohSection(credentials=str(authority.bundle("rm3")), listen=(f"tls/127.0.0.1:{port}",))
    settings = robot_settings(section, tmp_path, "robominer/rm3")
    robot = PublishedRobot(f"tls/localhost:{port}", settings=settings)

    def options(name: str) -> tuple[str, ...]:
        return "--connect", robot.endpoint, "--timeout", "15", "--credentials", str(authority.bundle(name))

    with (
        robot,
        console(tmp_path / "bob", *options("bob")) as viewers,
        console(tmp_path / "alice", *options("alice")) as operators,
    ):
        page = opened(chromium, viewers)
        # Telemetry and the map's changes alone come by this link.
        expect(page.locator("body")).to_have_attribute("data-link", "live", timeout=PATIENCE_MS)
        expect(page.locator("[data-whisker='17']")).to_have_attribute("data-state", "touch")
        page.wait_for_function("parseInt(document.querySelector('.map-count').textContent) > 0")
        expect(page.get_by_test_id("waypoint")).to_be_hidden()
        result = pressed(page, "cmd-rezero")
        expect(result).to_have_attribute("data-outcome", "unanswered", timeout=PATIENCE_MS)
        expect(result).to_contain_text("not answered")
        expect(result).to_contain_text("may look on but not command")
        assert robot.commands == []
        page.goto(operators)
        expect(page.locator("body")).to_have_attribute("data-link", "live", timeout=PATIENCE_MS)
        expect(pressed(page, "cmd-rezero")).to_have_attribute("data-outcome", "done", timeout=PATIENCE_MS)
        assert complaints_of(page) == []
        page.close()


def test_beyond_loopback_the_token_is_needed(chromium: Browser, tmp_path: Path):
    with PublishedRobot(f"tcp/127.0.0.1:{free_port()}") as robot:
        options = ("--connect", robot.endpoint, "--host", "0.0.0.0", "--token", "secret")
        with console(tmp_path / "log", *options) as address:
            local = address.replace("0.0.0.0", "127.0.0.1")
            bare = local.partition("?")[0]
            assert status_of(bare) == status_of(bare + "export/map.ply") == 401
            assert status_of(bare + "?token=wrong") == 401
            page = opened(chromium, local)
            expect(page.locator("body")).to_have_attribute("data-link", "live", timeout=PATIENCE_MS)
            assert "secret" not in page.url
            page.close()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--connect", "tcp/127.0.0.1:1", "--port", "0", "--timeout", "0.3"], "is the robot's program running?"),
        (["--host", "0.0.0.0"], "give --token"),
        (["--recording", "no-such.mcap"], "no-such.mcap"),
    ],
)
def test_mistakes_are_one_line_and_exit_code_2(arguments: list[str], expected: str):
    done = subprocess.run(program("operator", *arguments), capture_output=True, text=True, timeout=30.0, check=False)
    assert done.returncode == 2, done.stderr
    assert expected in done.stderr
    assert "Traceback" not in done.stderr


def test_a_missing_extra_is_said():
    code = "import sys; sys.modules['nicegui'] = None; from robominer_slam.cli.main import main; main()"
    command = [sys.executable, "-c", code, "operator"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30.0, check=False)
    assert done.returncode == 2
    assert "pip install 'robominer-slam[operator]'" in done.stderr


def test_a_port_in_use_is_said():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        done = subprocess.run(
            program("operator", "--port", port), capture_output=True, text=True, timeout=30.0, check=False
        )
    assert done.returncode == 2
    assert f"--port {port}" in done.stderr
    assert "give another --port" in done.stderr


def test_a_recording_opens_in_the_same_console(chromium: Browser, tmp_path: Path):
    short = tmp_path / "short.mcap"
    drive = ["--scenario", "1", "--engine", "quasi-static", "--max-time", "14", "--out", str(tmp_path / "sim")]
    subprocess.run(program("simulate", *drive, "--record", str(short)), check=True, capture_output=True, timeout=100.0)
    with console(tmp_path / "log", "--recording", str(short)) as address:
        page = opened(chromium, address)
        expect(page.locator("[data-field='link']").first).to_have_text("recording", timeout=60_000)
        expect(page.locator("body")).to_have_attribute("data-link", "recording")
        page.wait_for_function("parseInt(document.querySelector('.map-count').textContent) > 0")
        assert abs(float(page.get_by_test_id("time-line").locator("input").get_attribute("max")) - 14_000) < 1500
        page.get_by_test_id("cmd-rezero").click()
        page.get_by_test_id("ask").get_by_test_id("confirm").click()
        expect(page.get_by_test_id("command-result").first).to_contain_text("refused. this is a recording")
        with urllib.request.urlopen(f"{address}export/map.ply") as answer:
            assert answer.read(3) == b"ply"
        with urllib.request.urlopen(f"{address}export/poses.tum") as answer:
            assert len(answer.read().splitlines()) > 100
        page.close()


def test_a_simulated_robot_takes_waypoints_over_zenoh(tmp_path: Path):
    endpoint, out = f"tcp/127.0.0.1:{free_port()}", tmp_path / "sim"
    simulate = program(
        "simulate", "--scenario", "0", "--engine", "quasi-static", "--out", str(out), "--listen", endpoint,
        "--zenoh-waypoints", "--wait", "0", "--json",
    )  # fmt: skip
    with ZenohBus(ZenohSettings(listen=(endpoint,)), "robominer/rm3") as bus:
        process = subprocess.Popen(simulate, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            answer = None
            end = time.monotonic() + 30.0
            while answer is None and time.monotonic() < end:
                try:
                    answer = bus.get("sim/waypoint", timeout_s=0.5)
                except QueryError:
                    assert process.poll() is None
                    time.sleep(0.1)
            assert answer is not None
            far = {"x": "900", "y": "0", "yaw": "0", "id": "a"}
            near = {"x": "0.5", "y": "0.1", "yaw": "1.5", "id": "b"}
            refused, taken, again = (json.loads(bus.get("sim/waypoint", p)[0].payload) for p in (far, near, near))
        finally:
            process.terminate()
            process.wait(20.0)
    assert not refused["ok"]
    assert "outside the ground" in refused["message"]
    assert taken["ok"]
    assert again == taken
