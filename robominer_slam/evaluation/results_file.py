"""Results of an evaluation as JSON: the table, every run's record, and where its saved run lies."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from robominer_slam.evaluation.acceptance import acceptance_table
from robominer_slam.evaluation.campaign import Campaign
from robominer_slam.evaluation.run_record import ResultsError, RunRecord

RESULTS = "results.json"
FORMAT = 1


def results(campaign: Campaign, folder: Path) -> dict[str, Any]:
    """Everything for JSON; saved runs named relative to `folder`."""
    return {
        "format": FORMAT,
        "table": [row.as_dict() for row in acceptance_table(campaign.records)],
        "runs": [
            {**record.as_dict(), "file": Path(os.path.relpath(file, folder)).as_posix()}
            for record, file in zip(campaign.records, campaign.files, strict=True)
        ],
        "failures": [
            {"recording": failure.task.path.stem, "method": failure.task.key.series,
             "source": failure.task.key.source, "reason": failure.reason}
            for failure in campaign.failures
        ],
    }  # fmt: skip


def write_results(campaign: Campaign, folder: Path) -> Path:
    """Write `results.json` into the folder."""
    path = folder / RESULTS
    path.write_text(json.dumps(results(campaign, folder), indent=1) + "\n", encoding="utf-8")
    return path


def read_results(paths: Iterable[Path]) -> tuple[list[RunRecord], list[Path]]:
    """Records and saved runs of one or several results files; of the same run in several, the last counts.

    Raises:
        ResultsError: a file is not the JSON of results.
    """
    found: dict[Any, tuple[RunRecord, Path]] = {}
    for path in paths:
        for record, file in _read(path):
            found[record.key] = (record, file)
    if not found:
        raise ResultsError("no runs in these results")
    return [record for record, _ in found.values()], [file for _, file in found.values()]


def _read(path: Path) -> Sequence[tuple[RunRecord, Path]]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["format"] != FORMAT:
            raise ResultsError(f"{path}: format {data['format']}, expected {FORMAT}")
        runs = []
        for run in data["runs"]:
            file = path.parent / run.pop("file")
            runs.append((RunRecord.from_dict(run), file))
    except ResultsError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ResultsError(f"{path}: not the results of an evaluation: {type(error).__name__} {error}") from error
    return runs
