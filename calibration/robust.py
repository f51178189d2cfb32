"""Statistics that a few wrong samples do not move, over padded samples: weight 0 marks a sample that is none."""

from __future__ import annotations

import numpy as np

from calibration.polynomial import FloatArray

#: Share of the largest errors that a robust mean leaves out, for 5 % of outliers and drags that went aside; and what
#: it then has of the mean of squares (exponential distribution: two components).
TRIMMED, TRIMMED_SHARE = 0.2, 0.598


def used_median(values: FloatArray, weight: FloatArray) -> FloatArray:
    """Median over the samples in use, shape (n,), of values of shape (n, m)."""
    ordered = np.sort(np.where(weight > 0.0, values, np.inf), axis=1)
    middle = np.maximum((weight > 0.0).sum(axis=1) - 1, 0) // 2
    median: FloatArray = np.take_along_axis(ordered, middle[:, None], axis=1)[:, 0]
    return median


def trimmed_rms(squared: FloatArray, weight: FloatArray) -> FloatArray:
    """RMS of errors without the largest fifth, corrected for that, shape (n,), from squares of shape (n, m)."""
    ordered = np.sort(np.where(weight > 0.0, squared, np.inf), axis=1)
    kept = np.maximum(np.floor((weight > 0.0).sum(axis=1) * (1.0 - TRIMMED)).astype(int), 1)
    inside = np.arange(squared.shape[1]) < kept[:, None]
    mean = np.where(inside, np.where(np.isfinite(ordered), ordered, 0.0), 0.0).sum(axis=1) / kept
    rms: FloatArray = np.sqrt(mean / TRIMMED_SHARE)
    return rms
