"""The page: the acceptance table, then the thesis's figures 16 to 30 for whatever was run."""

from __future__ import annotations

import html
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from robominer_slam.evaluation.acceptance import acceptance_table
from robominer_slam.evaluation.page import boxplots, plans
from robominer_slam.evaluation.page.colours import ODOMETRY_NAME, Style, styles
from robominer_slam.evaluation.page.pictures import picture
from robominer_slam.evaluation.page.run_view import DriveViews, RunView, read_views
from robominer_slam.evaluation.page.style import STYLE
from robominer_slam.evaluation.page.tables import SOURCES, acceptance_html, runs_html
from robominer_slam.evaluation.run_record import RunRecord
from robominer_slam.evaluation.run_result import RunResult

#: The thesis's figures of each scenario: height map, path, and pose graph where it shows one.
THESIS_FIGURES = {"scenario 1": "17, 18", "scenario 2": "19, 20", "scenario 3": "21, 22", "scenario 4": "23 to 25",
                  "scenario 5": "26 to 28"}  # fmt: skip
#: The thesis repeated this one; its runs are shown unfolded.
REPEATED = "scenario 3"
INTRODUCTION = """
<p>A robot drives without seeing: it feels the ground with whiskers, and knows its motion from odometry only. Each
method of simultaneous localisation and mapping (SLAM) gets the same recordings. Errors are distances in x and y from
the true position at each whisker frame, without any alignment: all start at the same known pose, and what is drawn
is the pose as it was published at that time, not corrected afterwards.</p>
<ul class="note">
<li>A run is worse than odometry if its mean error is larger by more than 5&nbsp;% and 5&nbsp;mm.</li>
<li>A loop closure is wrong if it is off by more than 0.10&nbsp;m or 5&nbsp;deg; closures that the robust kernel has
left a weight of 0.1 or less do not count.</li>
<li>Height errors: map against true surface in touched 2&nbsp;cm cells that slope by less than 30&nbsp;deg and lie over
3&nbsp;cm from a step, after one constant offset was removed.</li>
<li>Within 99&nbsp;%: share of the frames whose error in x, y and heading lies within the 99&nbsp;% region of the
published covariance; below 99 the covariance promises too much. Sigma over error: above 1 it promises too little.</li>
</ul>
"""


def write_page(path: Path, records: Sequence[RunRecord], files: Sequence[Path],
               on_done: Callable[[str], None] = lambda _: None) -> None:  # fmt: skip
    """Write the page.

    Args:
        path: HTML file to write.
        records: of the runs.
        files: their saved runs, in the same order.
        on_done: called with the name of each part that is drawn, for progress.

    Raises:
        ResultsError: a saved run is missing or damaged.
    """
    path.write_text(page(records, files, on_done), encoding="utf-8")


def page(records: Sequence[RunRecord], files: Sequence[Path], on_done: Callable[[str], None] = lambda _: None) -> str:
    """The page's text; see `write_page`."""
    views = read_views(records, files)
    series = list(dict.fromkeys(name for one in views for name in one.series))
    look = styles(series)
    drives = list(dict.fromkeys(one.drive for one in views))
    sources = list(dict.fromkeys(one.source for one in views))
    title = "Blind SLAM against the truth"
    parts = [f"<h1>{title}</h1>", INTRODUCTION, _links(drives), '<h2 id="table">All runs</h2>']
    parts.append(acceptance_html(acceptance_table(records)))
    parts.append('<h2 id="errors">Position errors of all drives</h2><div class="pictures">')
    for source in sources:
        own = [one for one in views if one.source == source]
        figure = boxplots.errors_by_drive(own, [s for s in series if any(s in one.series for one in own)], look)
        caption = f"As the thesis's figure 16. {boxplots.HOW_TO_READ}; all runs of a drive together."
        parts.append(picture(figure, f"Odometry: {_source(source)}", caption, "svg"))
    parts.append("</div>")
    for drive in drives:
        own = [one for one in views if one.drive == drive]
        parts.append(_drive(drive, own, look))
        on_done(drive)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def _drive(drive: str, views: Sequence[DriveViews], look: Mapping[str, Style]) -> str:
    thesis = f' <span class="note">(thesis, figures {THESIS_FIGURES[drive]})</span>' if drive in THESIS_FIGURES else ""
    parts = [f'<h2 id="{_anchor(drive)}">{html.escape(_heading(drive))}{thesis}</h2>']
    first = views[0].runs[0].record
    parts.append(
        f'<p class="note">{first.distance_m:.1f} m in {first.duration_s:.0f} s, {first.frames} whisker frames.</p>'
        f"<details><summary>Figures of every run</summary>{runs_html(views)}</details>"
    )
    for one in views:
        parts.append(_shown(one, look))
        if len(one.seeds) > 1:
            parts.append(_repeats(one, look))
    return "".join(parts)


def _shown(one: DriveViews, look: Mapping[str, Style]) -> str:
    """Path, map and graph of one odometry noise."""
    seed = one.shown_seed()
    odometry = next(run for run in one.odometry() if run.key.odometry_seed == seed)
    runs = [run for name in one.series for run in one.of_series(name) if run.key.odometry_seed == seed]
    window = plans.window_of(odometry.truth, [run.slam for run in runs])
    parts = [f"<h3>Odometry: {html.escape(_source(one.source))}</h3>"]
    if len(one.seeds) > 1:
        parts.append(
            f'<p class="note">Of {len(one.seeds)} odometry noises, number {seed} is shown: '
            "the one of median error with the last method.</p>"
        )
    parts.append('<div class="pictures">')
    means = "; ".join([f"odometry {odometry.record.odometry_position_m.mean:.3f} m", *map(_mean, runs)])
    around = plans.window_of(odometry.truth, [odometry.odometry, *(run.slam for run in runs)])
    figure = plans.paths(runs, odometry, look, around)
    parts.append(picture(figure, f"Paths, {one.drive}", f"Mean errors: {means}."))
    full = [(run, run.full()) for run in runs]
    limits = _height_limits([result for _, result in full])
    true_surface = next(
        (f for _, result in full if (f := plans.true_heights(result, limits, window)) is not None), None
    )
    if true_surface is not None:
        parts.append(
            picture(true_surface, "True surface", "What the height maps should show, where anything was touched.")
        )
    for run, result in full:
        if np.isfinite(result.grid.height).any():
            caption = "Mean height of the touches in 2 cm cells of the final map; white: not touched."
            if run.record.height is not None:
                caption += f" RMS error against the true surface {1e3 * run.record.height.rms_m:.1f} mm."
            figure = plans.heights(result.grid, limits, window)
            parts.append(picture(figure, f"Height map, {run.key.series}", caption))
        if result.graph["keyframes"]:
            closures = run.record.closures
            caption = f"Closures are drawn as arcs: {closures.true} true, {closures.wrong} wrong."
            parts.append(picture(plans.pose_graph(result, window), f"Pose graph, {run.key.series}", caption))
    return "".join([*parts, "</div>"])


def _repeats(one: DriveViews, look: Mapping[str, Style]) -> str:
    """All odometry noises of a drive."""
    name = f"{_heading(one.drive)}, {len(one.seeds)} runs that differ in the odometry's noise"
    caption = f"As the thesis's figure 29. {boxplots.HOW_TO_READ}."
    parts = [picture(boxplots.errors_by_run(one, look), name, caption, "svg")]
    shown: list[tuple[str, Sequence[RunView]]] = [(ODOMETRY_NAME, one.odometry())]
    shown += [(series, one.of_series(series)) for series in one.series]
    everything = [run.odometry if series == ODOMETRY_NAME else run.slam for series, runs in shown for run in runs]
    window = plans.window_of(shown[0][1][0].truth, everything)
    for series, runs in shown:
        figure = plans.all_paths(runs, series, look, window)
        parts.append(picture(figure, f"All runs, {series}", "As the thesis's figure 30, with paths instead of maps."))
    unfolded = " open" if one.drive == REPEATED else ""
    return (
        f"<details{unfolded}><summary>{html.escape(name)}</summary>"
        f'<div class="pictures">{"".join(parts)}</div></details>'
    )


def _height_limits(results: Sequence[RunResult]) -> tuple[float, float]:
    """Limits of the colours that serve all maps of a drive, m."""
    heights = [result.grid.height[np.isfinite(result.grid.height)] for result in results]
    everything = np.concatenate([*heights, np.zeros(0)])
    if not len(everything):
        return 0.0, 1.0
    low, high = np.percentile(everything, (1, 99))
    return float(low), float(high)


def _mean(run: RunView) -> str:
    return f"{run.key.series} {run.record.slam_position_m.mean:.3f} m"


def _source(source: str) -> str:
    return SOURCES.get(source, source)


def _heading(drive: str) -> str:
    return drive[:1].upper() + drive[1:]


def _anchor(drive: str) -> str:
    return "drive-" + re.sub(r"[^A-Za-z0-9]+", "-", drive)


def _links(drives: Sequence[str]) -> str:
    links = [("table", "All runs"), ("errors", "Errors"), *((_anchor(drive), _heading(drive)) for drive in drives)]
    return "<nav>" + " ".join(f'<a href="#{anchor}">{html.escape(name)}</a>' for anchor, name in links) + "</nav>"
