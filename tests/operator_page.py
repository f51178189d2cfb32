"""The operator's console as a process, and its page in the system's Chromium, for the tests."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
#: Software drawing, and none of the browser's own traffic.
FLAGS = [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
]  # fmt: skip
#: A browser that cannot draw in 3D.
NO_GRAPHICS = [
    "--no-sandbox",
    "--no-first-run",
    "--disable-gpu",
    "--disable-3d-apis",
    "--disable-background-networking",
]
PATIENCE_MS = 20_000


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def program(*arguments: str) -> list[str]:
    return [sys.executable, "-c", "from robominer_slam.cli.main import main; main()", *arguments]


@contextlib.contextmanager
def console(log: Path, *arguments: str) -> Iterator[str]:
    """The console on a free port; gives the page's address, and at the end requires exit code 0."""
    with log.open("w+b") as out:
        process = subprocess.Popen(
            program("operator", "--port", "0", "--no-open", *arguments), stdout=out, stderr=subprocess.STDOUT
        )
        try:
            yield address_of(process, log)
            process.terminate()
            assert process.wait(15.0) == 0, log.read_text()
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()
    assert "Traceback" not in log.read_text(), log.read_text()


def address_of(process: subprocess.Popen[bytes], log: Path) -> str:
    end = time.monotonic() + 40.0
    while time.monotonic() < end:
        for line in log.read_text().splitlines():
            if "operator's console: " in line:
                return line.split("operator's console: ")[1]
        assert process.poll() is None, log.read_text()
        time.sleep(0.05)
    raise AssertionError(f"no address within 40 s: {log.read_text()}")


@contextlib.contextmanager
def browser(*flags: str) -> Iterator[Browser]:
    """Chromium of the system, with flags in place of ours. Where it is missing a test may be skipped, never in CI."""
    if not Path(CHROMIUM).exists():
        assert not os.environ.get("ROBOMINER_SLAM_CI"), "chromium is missing: apt-get install chromium"
        pytest.skip("chromium is missing: apt-get install chromium")
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, headless=True, args=[*(flags or FLAGS)])
        yield chromium
        chromium.close()


#: Of the pages that were opened.
_COMPLAINTS: dict[Page, list[str]] = {}


def complaints_of(page: Page) -> list[str]:
    """What the page's scripts have complained of since it was `opened`."""
    return _COMPLAINTS[page]


def opened(chromium: Browser, address: str, width: int = 900, height: int = 640) -> Page:
    """The page with the robot on it; what the page's scripts complain of fails the test that ends it."""
    page = chromium.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(PATIENCE_MS)
    complaints = _COMPLAINTS[page] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(address)
    page.wait_for_selector("[data-testid=map] canvas")
    return page


def stats(page: Page) -> dict[str, float]:
    """Frames drawn, latency (ms) and script time (ms) of the scene."""
    found: dict[str, float] = page.evaluate("window.robominerStream.stats")
    return found


def status_of(address: str, **headers: str) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=5.0) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code
