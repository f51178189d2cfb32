"""The operator's console in a real browser, with a robot's real messages on a real Zenoh session."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from robominer_slam.store_reader import load_map
from tests.operator_page import PATIENCE_MS, browser, complaints_of, console, free_port, opened, stats, status_of
from tests.published_robot import PublishedRobot
from tests.test_map_files import stored


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    with browser() as started:
        yield started


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "map.db"
    stored(path, "level 1")
    stored(path, "level 2")
    return path


@pytest.fixture(scope="module")
def robot(database: Path) -> Iterator[PublishedRobot]:
    robot = PublishedRobot(f"tcp/127.0.0.1:{free_port()}")
    robot.simulated = True
    robot.database = database
    with robot:
        yield robot


@pytest.fixture(scope="module")
def page(chromium: Browser, robot: PublishedRobot, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    log = tmp_path_factory.mktemp("operator") / "operator.log"
    with console(log, "--connect", robot.endpoint) as address:
        page = opened(chromium, address)
        yield page
        assert complaints_of(page) == []
        page.close()


def field(page: Page, name: str):
    return page.locator(f"[data-field='{name}']").first


def number(page: Page, name: str) -> float:
    return float(re.sub(r"[^0-9.-]", "", field(page, name).inner_text()))


def body_has(page: Page, name: str, value: str) -> None:
    expect(page.locator("body")).to_have_attribute(f"data-{name}", value, timeout=PATIENCE_MS)


def test_the_map_appears_and_grows(page: Page, robot: PublishedRobot):
    page.wait_for_function("parseInt(document.querySelector('.map-count').textContent) > 0")
    before = page.locator(".map-count").inner_text()
    page.wait_for_function("(b) => document.querySelector('.map-count').textContent != b", arg=before)
    expect(page.locator(".map-empty")).to_be_hidden()
    low, high = (float(page.locator(".legend-ticks span").nth(k).inner_text()) for k in (4, 0))
    assert -0.2 < low < high < 0.0
    assert re.fullmatch(r"\d+ c?m", page.locator(".map-scale").inner_text())


def test_other_sites_pages_get_nothing(page: Page):
    assert status_of(page.url) == 200
    assert status_of(page.url, Origin="http://elsewhere.example") == 403
    assert status_of(page.url, Host="elsewhere.example") == 403


def test_the_robot_moves_and_the_scene_is_drawn(page: Page, robot: PublishedRobot):
    body_has(page, "link", "live")
    expect(page.get_by_test_id("state")).to_have_text("localised")
    before, frames = field(page, "x").inner_text(), stats(page)["frames"]
    page.wait_for_function("(b) => document.querySelector('[data-field=x]').textContent != b", arg=before)
    page.wait_for_function("(n) => window.robominerStream.stats.frames > n + 3", arg=frames)
    assert abs(number(page, "x") - robot.pose()[0]) < 0.3
    expect(field(page, "sigma")).to_have_text("± 2.0 cm")


def test_a_whisker_bends_and_has_a_history(page: Page, robot: PublishedRobot):
    whisker = page.locator("[data-whisker='42']")
    expect(whisker).to_have_attribute("data-state", "free")
    robot.bend[42] = math.radians(30.0)
    expect(whisker).to_have_attribute("data-state", "touch")
    assert abs(float(whisker.get_attribute("data-inclination")) - 300.0) < 1.0
    # Azimuth pi of a whisker that points down is backward: down on the panel.
    assert float(whisker.locator(".bend").get_attribute("y2")) > 1.0
    whisker.click()
    expect(page.get_by_test_id("whisker-detail")).to_contain_text("Row 5, column 2: inclination 30.0°")
    expect(page.get_by_test_id("history-title")).to_contain_text("row 5, column 2")
    expect(page.get_by_test_id("history").locator("canvas")).to_be_visible()
    page.get_by_role("button", name="Close").click()
    del robot.bend[42]
    expect(whisker).to_have_attribute("data-state", "free")


def test_a_fault_shows_on_the_whisker_and_in_words(page: Page, robot: PublishedRobot):
    robot.faults[7] = "stuck for 12 s"
    expect(page.locator("[data-whisker='7']")).to_have_attribute("data-state", "fault")
    expect(page.locator("[data-whisker='7'] .fault")).to_have_text("St")
    expect(page.get_by_test_id("fault_count")).to_have_text("1 fault")
    page.get_by_role("tab", name="Robot and link").click()
    expect(page.get_by_test_id("faults")).to_contain_text("(0, 7) stuck")
    expect(field(page, "disk")).to_have_text("5100 MB free")
    robot.faults.clear()
    expect(page.get_by_test_id("fault_count")).to_have_text("no faults")
    page.get_by_role("tab", name="Drive").click()


def confirmed(page: Page, button: str) -> None:
    page.get_by_test_id(button).click()
    page.get_by_test_id("ask").get_by_test_id("confirm").click()


def test_a_command_is_confirmed_done_and_its_result_shown(page: Page, robot: PublishedRobot):
    robot.commands.clear()
    page.get_by_test_id("cmd-pause").click()
    page.get_by_role("button", name="Cancel").click()
    expect(page.get_by_test_id("ask")).to_be_hidden()
    assert robot.commands == []
    confirmed(page, "cmd-pause")
    result = page.get_by_test_id("command-result").first
    expect(result).to_have_attribute("data-outcome", "done")
    expect(result).to_contain_text("done. pause is done")
    [(name, parameters)] = robot.commands
    assert name == "pause"
    assert parameters["id"]
    # The robot says that it is paused: now it can be told to go on.
    expect(page.get_by_test_id("cmd-resume")).to_be_visible()


def test_a_refusal_looks_like_one(page: Page, robot: PublishedRobot):
    page.get_by_role("tab", name="Maps and log").click()
    confirmed(page, "cmd-new_map")
    result = page.get_by_test_id("command-result").last
    expect(result).to_have_attribute("data-outcome", "refused")
    expect(result).to_contain_text("refused. the map is frozen")
    expect(page.get_by_test_id("events")).to_contain_text("command new_map: refused")
    page.get_by_role("tab", name="Drive").click()


def test_a_waypoint_is_set_on_the_map(page: Page, robot: PublishedRobot):
    robot.waypoints.clear()
    page.get_by_test_id("waypoint").click()
    box = page.locator("[data-testid=map] canvas").bounding_box()
    page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 0.6 * box["height"])
    page.get_by_test_id("ask").get_by_test_id("confirm").click()
    expect(page.get_by_test_id("command-result").first).to_contain_text("Add waypoint: done")
    # While it fades, the dialog takes the pointer's clicks.
    expect(page.get_by_test_id("ask")).to_have_count(0)
    [(x, y)] = robot.waypoints
    assert math.hypot(x - robot.pose()[0], y - robot.pose()[1]) < 3.0


#: Points are there, and the scale bar has stayed as it is for thirty frames.
SETTLED = """() => new Promise((settled) => {
  let before = "", same = 0;
  const look = () => {
    const bar = document.querySelector(".map-scale");
    const now = bar.innerText + bar.getBoundingClientRect().width;
    same = now === before ? same + 1 : 0;
    before = now;
    if (same >= 30) settled(true); else requestAnimationFrame(look);
  };
  look();
})"""


def test_saved_maps_are_listed_and_downloaded(page: Page, database: Path):
    page.get_by_role("tab", name="Maps and log").click()
    page.get_by_test_id("list-maps").click()
    rows = page.get_by_test_id("saved-maps").locator("li")
    expect(rows).to_have_count(2)
    expect(rows.first).to_contain_text("level 2")
    expect(rows.last).to_contain_text("level 1 (present)")
    expect(rows.last).to_contain_text("begun 20")
    with page.expect_download() as download:
        rows.first.get_by_role("link", name="PLY").click()
    content = Path(download.value.path()).read_bytes()
    assert content.startswith(b"ply\nformat binary_little_endian")
    assert download.value.suggested_filename == "rm3-map-2.ply"
    # Two points that fall on the same millimetre are one.
    points = sum(len(k.points) for k in load_map(database, "2")[1].keyframes)
    assert 0.99 * points <= int(re.search(rb"element vertex (\d+)", content)[1]) <= points
    assert status_of(f"{page.url}saved/9.ply") == 404
    page.get_by_role("tab", name="Drive").click()


def test_distances_and_heights_are_measured(page: Page, robot: PublishedRobot):
    page.locator("[data-testid=map] canvas").focus()
    page.keyboard.press("t")
    page.keyboard.press("a")
    page.keyboard.press("m")
    # The view is drawn when something changed: what is clicked must be what the scale tells.
    page.wait_for_function(SETTLED)
    box = page.locator("[data-testid=map] canvas").bounding_box()
    for share in (0.4, 0.6):
        page.mouse.click(box["x"] + share * box["width"], box["y"] + 0.5 * box["height"])
    label = page.locator(".map-label:visible")
    expect(label).to_contain_text("level")
    level = float(re.search(r"level ([0-9.]+) m", label.inner_text())[1])
    bar = page.locator(".map-scale")
    length = float(bar.inner_text().split()[0]) * (0.01 if "cm" in bar.inner_text() else 1.0)
    per_pixel = length / bar.bounding_box()["width"]
    # The ends snap to touched points within nine pixels of the pointer.
    assert abs(level - 0.2 * box["width"] * per_pixel) < 20 * per_pixel
    page.keyboard.press("Escape")
    expect(page.locator(".map-label")).to_have_count(0)
    page.keyboard.press("p")
    page.keyboard.press("f")


def test_the_past_is_shown_and_now_comes_back(page: Page, robot: PublishedRobot):
    slider = page.get_by_test_id("time-line").locator("input")
    slider.focus()
    page.keyboard.press("Home")
    body_has(page, "showing", "past")
    shown = page.evaluate("window.robominerStream.last.get('live')")
    assert abs(shown["stamp"] - shown["span"][0]) < 1.0
    assert abs(number(page, "x") - shown["pose"][0]) < 0.011
    assert shown["slots"] < len(robot.keyframes)
    page.get_by_test_id("now").click()
    body_has(page, "showing", "now")


def test_in_the_past_the_status_is_that_of_then(page: Page, robot: PublishedRobot):
    whisker = page.locator("[data-whisker='9']")
    expect(whisker).to_have_attribute("data-state", "free")
    robot.faults[9] = "stuck for 12 s"
    # Telemetry leaves it out at once; why is in the status after it.
    expect(whisker.locator(".fault")).to_have_text("St")
    faulty_ms = time.time_ns() // 1_000_000
    robot.faults.clear()
    expect(whisker).to_have_attribute("data-state", "free")
    page.evaluate("(stamp) => window.robominerStream.seek(stamp)", faulty_ms)
    expect(whisker.locator(".fault")).to_have_text("St")
    page.evaluate("window.robominerStream.seek(null)")
    expect(whisker).to_have_attribute("data-state", "free")


def test_another_map_takes_the_place_of_the_old_one(page: Page, robot: PublishedRobot):
    shown = "parseInt(document.querySelector('.map-count').textContent.replace(',', ''))"
    before = page.evaluate(shown)
    robot.begin_map()
    page.wait_for_function(f"(b) => {shown} < b / 2", arg=before)
    page.wait_for_function(f"{shown} > 0")


def test_a_cut_link_is_stale_within_a_second_and_recovers(page: Page, robot: PublishedRobot):
    body_has(page, "link", "live")
    page.evaluate("""() => { window.staleAt = null; new MutationObserver(() => {
        const stale = document.body.dataset.link === 'stale';
        if (stale) window.staleAt ??= performance.now() - window.robominerStream.heardAt;
    }).observe(document.body, {attributes: true}); }""")
    robot.stop()
    body_has(page, "link", "stale")
    page.wait_for_function("window.staleAt !== null")
    assert page.evaluate("window.staleAt") < 1000.0
    expect(field(page, "link")).to_contain_text("no data for", timeout=PATIENCE_MS)
    assert float(page.locator(".header-figures").evaluate("e => getComputedStyle(e).opacity")) < 0.5
    page.get_by_role("tab", name="Robot and link").click()
    robot.start()
    body_has(page, "link", "live")
    page.wait_for_function("document.querySelector('[data-field=outages]').textContent.startsWith('1')")
    before = page.locator(".map-count").inner_text()
    page.wait_for_function("(b) => document.querySelector('.map-count').textContent != b", arg=before)
