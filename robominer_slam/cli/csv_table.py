"""Tables of numbers from CSV files, with messages that name file and line."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from calibration.fit import FitError


def read_records(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Names of the columns, and rows by name.

    Raises:
        FitError: unreadable, or not text.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            records = list(reader)
            return list(reader.fieldnames or []), records
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FitError(f"{path}: cannot be read as CSV: {error}") from error


def read_table(path: Path, columns: Sequence[str]) -> list[list[float]]:
    """Rows of a CSV file's named columns.

    Raises:
        FitError: a column is missing, or a value is not a number; the message names file and line.
    """
    names, records = read_records(path)
    missing = [name for name in columns if name not in names]
    if missing:
        raise FitError(f"{path}: lacks the columns {', '.join(missing)}; expected {', '.join(columns)}")
    rows = []
    for line, record in enumerate(records, start=2):
        try:
            rows.append([float(record[name]) for name in columns])
        except (TypeError, ValueError):
            raise FitError(f"{path}, line {line}: expected numbers in {', '.join(columns)}") from None
    return rows


def first_of(path: Path, names: Sequence[str], wanted: dict[str, float]) -> tuple[str, float]:
    """The first of some columns that a table has, and the factor to its SI unit.

    Raises:
        FitError: none of them is there.
    """
    for name, factor in wanted.items():
        if name in names:
            return name, factor
    raise FitError(f"{path}: expected a column {' or '.join(wanted)}; found {', '.join(names) or 'none'}")
