"""Reads a calibration file on its own, without a configuration."""

from __future__ import annotations

from pathlib import Path

from calibration.file_format import Calibration, CalibrationFileError, from_text


def read_calibration_file(path: Path) -> Calibration:
    """Read and parse a calibration.

    Raises:
        CalibrationFileError: unreadable, damaged, or of another version.
    """
    try:
        return from_text(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationFileError(f"{path}: the calibration cannot be read: {error}") from error
