"""A browser that cannot draw in 3D: the console says so, and the rest of the page works."""

from __future__ import annotations

from pathlib import Path

from playwright.sync_api import expect

from tests.operator_page import NO_GRAPHICS, browser, complaints_of, console, free_port, opened
from tests.published_robot import PublishedRobot


def test_without_graphics_the_page_says_so_and_the_panels_work(tmp_path: Path):
    with (
        browser(*NO_GRAPHICS) as plain,
        PublishedRobot(f"tcp/127.0.0.1:{free_port()}") as robot,
        console(tmp_path / "operator.log", "--connect", robot.endpoint) as address,
    ):
        page = opened(plain, address)
        expect(page.get_by_test_id("no-graphics")).to_contain_text("no WebGL 2")
        expect(page.get_by_test_id("state")).to_have_text("localised")
        expect(page.locator("[data-whisker='17']")).to_have_attribute("data-state", "touch")
        assert complaints_of(page) == []
