"""Reads what belongs to the whisker array: its layout and its calibration. Files in, checked objects out."""

from __future__ import annotations

from pathlib import Path

from calibration.file_format import Calibration, check_fits, from_text
from robominer_slam import layout as layouts
from robominer_slam.calibrated_array import CalibratedArray
from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.configuration.model import Configuration
from robominer_slam.layout import LayoutError, WhiskerLayout


def load_layout(name_or_path: str, relative_to: Path) -> WhiskerLayout:
    """A built-in layout by name, or one from a file (relative to the configuration's folder).

    Raises:
        LayoutError: neither a built-in name nor a readable layout file.
    """
    if name_or_path in layouts.BUILT_IN:
        return layouts.BUILT_IN[name_or_path]()
    path = relative_to / name_or_path
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        known = ", ".join(layouts.BUILT_IN)
        raise LayoutError(
            f"layout {name_or_path!r}: expected a built-in name ({known}) or the path of a layout file: {error}"
        ) from error
    return layouts.from_json(text, str(path))


def calibration_path(configuration: Configuration, relative_to: Path) -> Path | None:
    """The calibration file of the device that carries the whiskers, or None if no device names one.

    Raises:
        ConfigurationError: two devices name calibrations.
    """
    named = [device for device in configuration.device if device.calibration is not None]
    if len(named) > 1:
        names = ", ".join(device.name for device in named)
        raise ConfigurationError(f"devices {names}: expected a calibration on one device only")
    return relative_to / str(named[0].calibration) if named else None


def load_calibration(text: str, where: str, layout: WhiskerLayout) -> Calibration:
    """Parse a calibration and refuse one of another array.

    Raises:
        CalibrationFileError: damaged, another version, another array.
    """
    calibration = from_text(text, where)
    check_fits(calibration, layout=layout.name, rows=layout.rows, cols=layout.cols, where=where, p_base=layout.p_base)
    return calibration


def read_calibration(path: Path, layout: WhiskerLayout) -> Calibration:
    """Read and check a calibration file; raises ConfigurationError if it cannot be read, and as above."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(
            f"{path}: the calibration cannot be read ({error}); make one with 'robominer-slam calibrate fit'"
        ) from error
    return load_calibration(text, str(path), layout)


def calibrated_array(configuration: Configuration, folder: Path) -> CalibratedArray:
    """The configured layout with the calibration of the device that carries the whiskers.

    Raises:
        ConfigurationError: no device names a calibration, or it cannot be read.
        LayoutError, CalibrationFileError: it cannot be used.
    """
    layout = load_layout(configuration.robot.layout, folder)
    path = calibration_path(configuration, folder)
    if path is None:
        raise ConfigurationError(
            "device: expected calibration = 'FILE.json' on the [[device]] that carries the whiskers; "
            "make one with 'robominer-slam calibrate fit'"
        )
    return CalibratedArray(layout, read_calibration(path, layout).model)
