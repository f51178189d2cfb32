"""Many replays into one table and one page: the plan, resuming, the command line, the page by itself."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from drivers.recording_reader import Recording
from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.configuration.model import Configuration
from robominer_slam.configuration.overrides import Variant, overridden, parse_override, parse_variant
from robominer_slam.evaluation import campaign as campaigns
from robominer_slam.evaluation.acceptance import acceptance_table, text_tables
from robominer_slam.evaluation.campaign import plan, run_tasks
from robominer_slam.evaluation.height_errors import HeightFunction
from robominer_slam.evaluation.page.page import page
from robominer_slam.evaluation.results_file import read_results, write_results
from robominer_slam.evaluation.run_record import ResultsError
from robominer_slam.evaluation.run_result import load_result
from robominer_slam.evaluation.run_task import evaluate_run
from sim_backend import world
from sim_backend.demo import program
from sim_backend.recorded_drive import with_other_odometry
from sim_backend.robot import RobotSettings
from sim_backend.simulate import SimulationSettings, record_drive

KERNEL = Variant("no kernel", (("slam.thesis.kernel", "none"),))


def surface_of(metadata) -> HeightFunction:
    return world.load(metadata["world"]).height


@pytest.fixture(scope="module")
def recordings(tmp_path_factory) -> list[Path]:
    """12 s of scenario 2 with two odometry noises."""
    folder = tmp_path_factory.mktemp("recordings")
    first, second = folder / "drive-0.mcap", folder / "drive-1.mcap"
    robot = RobotSettings(seed=1, odometry_seed=0, max_time=12.0)
    record_drive(SimulationSettings(folder, scenario=2, engine="quasi-static", robot=robot), first)
    with_other_odometry(Recording(first), 1, second)
    return [first, second]


@pytest.fixture(scope="module")
def evaluated(recordings, tmp_path_factory) -> tuple[Path, campaigns.Campaign]:
    folder = tmp_path_factory.mktemp("evaluated")
    tasks = plan(recordings, ["none", "thesis"], ["fused", "odometry"])
    campaign = run_tasks(tasks, folder, surface_of=surface_of)
    write_results(campaign, folder)
    return folder, campaign


def cli(*arguments: object, expect: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(program("evaluate", *map(str, arguments)), capture_output=True, text=True, timeout=120,
                          check=False)  # fmt: skip
    assert done.returncode == expect, done.stderr
    assert "Traceback" not in done.stderr
    return done


def test_the_fused_odometry_is_replayed_once(recordings):
    tasks = plan(recordings, ["none", "thesis"], ["fused", "odometry"], [KERNEL])
    keys = [(t.key.source, t.key.odometry_seed, t.key.method, t.key.variant) for t in tasks]
    assert keys == [
        ("fused", None, "none", ""), ("fused", None, "thesis", ""), ("fused", None, "thesis", "no kernel"),
        ("odometry", 0, "none", ""), ("odometry", 0, "thesis", ""), ("odometry", 0, "thesis", "no kernel"),
        ("odometry", 1, "none", ""), ("odometry", 1, "thesis", ""), ("odometry", 1, "thesis", "no kernel"),
    ]  # fmt: skip
    assert len({task.file_name for task in tasks}) == len(tasks)
    assert [t.key.odometry_seed for t in plan(recordings, ["none"], ["odometry"], odometry_seeds=[1])] == [1]


def test_two_recordings_of_one_name_are_refused(recordings, tmp_path):
    shutil.copy(recordings[0], tmp_path / recordings[0].name)
    with pytest.raises(ResultsError, match="named drive-0"):
        plan([recordings[0], tmp_path / recordings[0].name], ["none"], ["fused"])


def test_figures_of_a_run(evaluated):
    _, campaign = evaluated
    assert not campaign.failures
    by_key = {(r.key.source, r.key.odometry_seed, r.key.method): r for r in campaign.records}
    none, thesis = by_key["odometry", 1, "none"], by_key["odometry", 1, "thesis"]
    assert none.slam_position_m == none.odometry_position_m == thesis.odometry_position_m
    assert none.odometry_position_m != by_key["odometry", 0, "none"].odometry_position_m
    assert none.states == {"dead_reckoning": 1.0}
    assert none.height is None
    assert thesis.keyframes > 0
    assert thesis.height is not None
    assert thesis.height.rms_m < 0.02
    assert thesis.frame_s is not None
    assert thesis.keyframe_s is not None
    assert thesis.real_time_factor > 1.0
    assert thesis.frames == pytest.approx(25 * thesis.duration_s, abs=2)


def test_a_saved_run_has_everything(evaluated):
    _, campaign = evaluated
    for record, file in zip(campaign.records, campaign.files, strict=True):
        result = load_result(file)
        assert result.record == record
        assert np.mean(result.slam_errors.position) == pytest.approx(record.slam_position_m.mean, abs=1e-12)
        assert np.mean(result.odometry_errors.position) == pytest.approx(record.odometry_position_m.mean, abs=1e-12)
        assert len(result.graph["keyframes"]) == record.keyframes


def test_an_interrupted_evaluation_goes_on(recordings, tmp_path, monkeypatch):
    tasks = plan(recordings, ["none"], ["fused", "odometry"])
    done = []

    def interrupt(task) -> None:
        done.append(task)
        if len(done) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_tasks(tasks, tmp_path, on_done=interrupt)
    assert len(list((tmp_path / "runs").glob("*.npz"))) == 2
    made = []
    monkeypatch.setattr(campaigns, "evaluate_run", lambda *a: made.append(a) or evaluate_run(*a))
    campaign = run_tasks(tasks, tmp_path)
    assert (len(made), campaign.reused, len(campaign.records)) == (1, 2, 3)
    # A damaged file and other overrides are no saved runs of these tasks.
    campaign.files[0].write_bytes(b"PK damaged")
    assert run_tasks(tasks, tmp_path).reused == 2
    other = plan(recordings, ["none"], ["fused", "odometry"], common=[("contact.min_inclination_deg", 6.0)])
    assert run_tasks(other, tmp_path).reused == 0


def test_a_run_that_fails_does_not_take_the_others_with_it(recordings, tmp_path, monkeypatch):
    tasks = plan(recordings, ["none"], ["odometry"])

    def fail(task, surface):
        if task is tasks[0]:
            raise ZeroDivisionError("broken\nin two lines")
        return evaluate_run(task, surface)

    monkeypatch.setattr(campaigns, "evaluate_run", fail)
    campaign = run_tasks(tasks, tmp_path)
    assert [f.reason for f in campaign.failures] == ["ZeroDivisionError: broken"]
    assert [record.recording for record in campaign.records] == ["drive-1"]


class _Page(HTMLParser):
    """Collects what a page refers to, and its tables."""

    def __init__(self) -> None:
        super().__init__()
        self.references: list[str] = []
        self.images: list[str] = []
        self.ids: list[str] = []
        self.alternatives: list[str | None] = []
        self.rows: list[list[str]] = []
        self.open: list[str] = []

    def handle_starttag(self, tag, attributes) -> None:
        values = dict(attributes)
        self.open.append(tag)
        assert tag not in ("script", "link", "iframe", "object", "embed")
        self.references += [v for k, v in attributes if k in ("href", "src", "srcset", "data", "poster")]
        if tag == "img":
            self.images.append(values["src"])
            self.alternatives.append(values.get("alt"))
        if "id" in values:
            self.ids.append(values["id"])
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_data(self, data) -> None:
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data

    def handle_endtag(self, tag) -> None:
        while self.open and self.open.pop() != tag:
            pass


@pytest.fixture(scope="module")
def parsed(evaluated) -> tuple[str, _Page]:
    _, campaign = evaluated
    text = page(campaign.records, campaign.files)
    parser = _Page()
    parser.feed(text)
    return text, parser


def test_the_page_needs_nothing_beside_itself(parsed):
    text, parser = parsed
    assert "http" not in text
    assert "url(" not in text
    assert "@import" not in text
    for reference in parser.references:
        assert reference.startswith(("data:image/", "#")), reference[:80]
    assert {r[1:] for r in parser.references if r.startswith("#")} <= set(parser.ids)
    # Boxes of two sources; for each paths, true surface, map and graph; for the noises boxes and two sets of paths.
    assert len(parser.images) == 2 + 2 * 4 + 3
    for image in parser.images:
        kind, data = re.fullmatch(r"data:image/(png|svg\+xml);base64,(.+)", image).groups()
        content = base64.b64decode(data, validate=True)
        assert content.startswith(b"\x89PNG" if kind == "png" else b"<?xml")
    assert all(parser.alternatives)


def test_the_page_fits_phone_and_dark_mode(parsed):
    text, _ = parsed
    assert 'name="viewport"' in text
    assert "color-scheme: light dark" in text


def test_a_page_of_odometry_alone(evaluated):
    _, campaign = evaluated
    alone = [(r, f) for r, f in zip(campaign.records, campaign.files, strict=True) if r.key.method == "none"]
    parser = _Page()
    parser.feed(page([r for r, _ in alone], [f for _, f in alone]))
    assert len(parser.images) == 2 + 2 + 2


def test_table_page_and_json_say_the_same(evaluated, parsed):
    folder, campaign = evaluated
    saved = json.loads((folder / "results.json").read_text())
    rows = acceptance_table(campaign.records)
    assert saved["table"] == [row.as_dict() for row in rows]
    records, files = read_results([folder / "results.json"])
    assert (records, files) == (campaign.records, campaign.files)
    _, parser = parsed
    for table in text_tables(rows):
        assert ["", *table.columns] in parser.rows
        for name, cells in table.lines:
            assert [name, *cells] in parser.rows


def test_the_command_runs_reports_and_renders(recordings, tmp_path):
    out, html = tmp_path / "out", tmp_path / "page.html"
    arguments = ("run", *recordings, "--methods", "none,thesis", "--sources", "odometry", "--variant",
                 "no kernel:slam.thesis.kernel=none", "--jobs", "2", "--out", out)  # fmt: skip
    first = json.loads(cli(*arguments, "--json").stdout)
    assert [(row["method"], row["variant"], row["runs"]) for row in first["table"]] == [
        ("none", "", 2), ("thesis", "", 2), ("thesis", "no kernel", 2),
    ]  # fmt: skip
    again = cli(*arguments)
    assert "6 runs, 6 of them from before" in again.stdout
    assert "thesis, no kernel" in again.stdout
    rendered = json.loads(cli("report", out / "results.json", "--report", html, "--json").stdout)
    assert rendered["table"] == first["table"]
    assert html.read_text().startswith("<!doctype html>")
    one = json.loads(cli("run", *recordings, "--methods", "none", "--sources", "odometry", "--odometry-seeds", "1",
                         "--out", tmp_path / "one", "--json").stdout)  # fmt: skip
    assert [run["recording"] for run in one["runs"]] == ["drive-1"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--methods", "magic"], "slam.method"),
        (["--sources", "gps"], "estimation.source"),
        (["--set", "slam.nonsense=1"], "slam.nonsense: unknown key"),
        (["--set", "slam"], "expected KEY=VALUE"),
        (["--set", "slam.thesis.kernel.x=1"], "slam.thesis.kernel"),
        (["--variant", "slam.thesis.kernel=none"], "expected LABEL:KEY=VALUE"),
        (["--odometry-seeds", "7"], "nothing to run"),
        (["--odometry-seeds", "x"], "expected numbers and ranges"),
    ],
)
def test_mistakes_are_told_in_one_line(recordings, tmp_path, arguments, message):
    done = cli("run", *recordings, *arguments, "--out", tmp_path / "out", expect=2)
    errors = [line for line in done.stderr.splitlines() if line.lower().startswith("error:")]
    assert len(errors) == 1
    assert message in errors[0]
    assert not done.stdout


def test_files_that_are_no_results_or_recordings(tmp_path):
    (tmp_path / "r.json").write_text("[1]")
    done = cli("report", tmp_path / "r.json", expect=2)
    assert "not the results of an evaluation" in done.stderr
    (tmp_path / "a.mcap").write_bytes(b"nothing")
    assert "error: " in cli("run", tmp_path / "a.mcap", "--out", tmp_path, expect=2).stderr
    assert "Options go behind 'report'" in cli("--json", "report", tmp_path / "r.json", expect=2).stderr
    assert "Missing option '--truth'" in cli("--odometry", tmp_path / "r.json", expect=2).stderr


def test_a_failed_run_is_told_and_counts(recordings, tmp_path):
    """A recording without ground truth replays, but cannot be evaluated."""
    from drivers.recording_writer import RecordingWriter

    source = Recording(recordings[0])
    bare = tmp_path / "bare.mcap"
    with RecordingWriter(bare, sensor_period_us=source.sensor_period_ns / 1000, attachments=source.attachments(),
                         metadata={}) as writer:  # fmt: skip
        for raw in source.raw_messages():
            if raw.topic != "ground_truth":
                writer.write(raw.topic, raw.typename, raw.data, raw.log_time_ns, raw.publish_time_ns)
    done = cli("run", bare, "--methods", "none", "--out", tmp_path / "out", expect=1)
    assert "no ground truth in this recording" in done.stderr


def test_overrides_are_validated_and_typed():
    assert parse_override("slam.backend_latency = 0.2") == ("slam.backend_latency", 0.2)
    assert parse_override("slam.thesis.kernel=none") == ("slam.thesis.kernel", "none")
    assert parse_override("a.b=false") == ("a.b", False)
    assert parse_variant("x y:a.b=1,c.d=text") == Variant("x y", (("a.b", 1), ("c.d", "text")))
    changed = overridden(Configuration(), {"slam.thesis.kernel": "none", "slam.backend_latency": 0.2}, "here")
    assert (changed.slam.thesis.kernel, changed.slam.backend_latency) == ("none", 0.2)
    assert changed.slam.thesis.min_travel == Configuration().slam.thesis.min_travel
    with pytest.raises(ConfigurationError, match=r"here: slam\.backend_latency"):
        overridden(Configuration(), {"slam.backend_latency": -1}, "here")


def test_a_variant_of_another_method_is_not_run():
    assert KERNEL.concerns("thesis")
    assert not KERNEL.concerns("none")
    assert not KERNEL.concerns("another")
    assert Variant("contacts", (("contact.min_inclination_deg", 6.0),)).concerns("none")
    assert Variant().concerns("none")
