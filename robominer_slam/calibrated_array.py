"""The whisker array as the program uses it: where its whiskers are, and what their fields mean."""

from __future__ import annotations

from dataclasses import dataclass

from calibration.polynomial import PolynomialModel
from robominer_slam.layout import WhiskerLayout


@dataclass(frozen=True, slots=True)
class CalibratedArray:
    """Layout and calibration that were checked to belong together."""

    layout: WhiskerLayout
    model: PolynomialModel
