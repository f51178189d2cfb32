"""Damping of a whisker's joint from a free oscillation: x(t) = x0 + A exp(-zeta w0 t) cos(wd t + p).

The thesis takes the logarithmic decrement from two successive amplitudes (Nagel 2021, section 3.4.2), which noise and
an unknown rest angle spoil. Here the whole curve is fitted, robustly; the decrement of its peaks stands beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibration.fit import FitError

FloatArray = NDArray[np.float64]

MIN_SAMPLES = 12
#: Trial values of the first search; the fit refines them.
TRIAL_RATIOS = (0.01, 0.03, 0.07, 0.15, 0.25, 0.35, 0.45, 0.55, 0.7, 0.85)
TRIAL_FREQUENCIES = 160
#: Peaks lower than this many times the noise carry no decrement.
PEAK_OVER_NOISE = 4.0


@dataclass(frozen=True, slots=True)
class Oscillation:
    """A damped free oscillation; sigmas are standard deviations.

    Attributes:
        damping_ratio, damping_ratio_sigma: zeta.
        decrement, decrement_sigma: logarithmic decrement per full period.
        peak_decrement: the same from successive peaks, None where fewer than two stand out of the noise.
        frequency_hz, frequency_sigma_hz: of the damped oscillation.
        natural_rad_s: undamped angular frequency, rad/s.
        rest_angle: rad.
        residual: RMS of the angles about the curve, rad.
        samples: readings used.
        start_s: time of the first one used, s.
    """

    damping_ratio: float
    damping_ratio_sigma: float
    decrement: float
    decrement_sigma: float
    peak_decrement: float | None
    frequency_hz: float
    frequency_sigma_hz: float
    natural_rad_s: float
    rest_angle: float
    residual: float
    samples: int
    start_s: float


def damping_ratio(decrement: float) -> float:
    """Zeta of a logarithmic decrement: delta / sqrt(delta^2 + (2 pi)^2)."""
    return decrement / float(np.hypot(decrement, 2.0 * np.pi))


def decrement(ratio: float) -> float:
    """Logarithmic decrement of a damping ratio below 1."""
    return 2.0 * np.pi * ratio / float(np.sqrt(1.0 - ratio**2))


def thesis_damping(ratio: float, mass: float, stiffness: float) -> float:
    """The thesis's viscous coefficient c = zeta sqrt(m k); mass in kg, stiffness in N/rad.

    Its units do not come out as N m s/rad; it is here to compare with the thesis.
    """
    return ratio * float(np.sqrt(mass * stiffness))


def physical_damping(ratio: float, inertia: float, stiffness: float) -> float:
    """Viscous coefficient of a rotating joint, c = 2 zeta sqrt(I k), N m s/rad; I in kg m2, k in N m/rad."""
    return 2.0 * ratio * float(np.sqrt(inertia * stiffness))


def rod_inertia(mass: float, length: float) -> float:
    """Moment of inertia of a uniform rod about its end, kg m2."""
    return mass * length**2 / 3.0


def _curve(rate: float, omega: float, t: FloatArray) -> FloatArray:
    """The three shapes whose sum the curve is, shape (m, 3): cosine, sine, rest angle."""
    fade = np.exp(-rate * t)
    return np.column_stack([fade * np.cos(omega * t), fade * np.sin(omega * t), np.ones_like(t)])


def _search(t: FloatArray, angle: FloatArray) -> tuple[float, float]:
    """Decay rate and angular frequency of the best of a grid of trial curves."""
    step = float(np.median(np.diff(t)))
    # From one swing in the record up to what the sampling can show.
    frequencies = np.geomspace(0.7 / (t[-1] - t[0]), 0.48 / step, TRIAL_FREQUENCIES) * 2.0 * np.pi
    best = (np.inf, 1.0, 1.0)
    for omega in frequencies:
        for ratio in TRIAL_RATIOS:
            rate = omega * ratio / np.sqrt(1.0 - ratio**2)
            shapes = _curve(rate, omega, t)
            left = angle - shapes @ np.linalg.lstsq(shapes, angle, rcond=None)[0]
            best = min(best, (float(left @ left), float(rate), float(omega)))
    return best[1], best[2]


def fit_oscillation(time: FloatArray, angle: FloatArray) -> Oscillation:
    """Fit a damped oscillation from its largest deflection on.

    Args:
        time: shape (m,), s, increasing.
        angle: shape (m,), rad, signed about any rest angle.

    Raises:
        FitError: too few samples, times that do not increase, or no oscillation in them.
    """
    if len(time) < MIN_SAMPLES:
        raise FitError(f"the oscillation has {len(time)} samples, expected at least {MIN_SAMPLES}")
    if not (np.diff(time) > 0.0).all() or not np.isfinite(angle).all():
        raise FitError("the oscillation's times must increase and its angles be finite numbers")
    settled = float(np.median(angle[-max(len(angle) // 4, 4) :]))
    # A held whisker before its release is no oscillation: the last reading near the largest deflection begins it.
    deflection = np.abs(angle - settled)
    start = int(np.flatnonzero(deflection >= 0.9 * deflection.max())[0])
    plateau = np.flatnonzero(deflection < 0.9 * deflection.max())
    start = max(int(plateau[plateau > start][0]) - 1, start) if (plateau > start).any() else start
    t, x = time[start:] - time[start], angle[start:]
    if len(t) < MIN_SAMPLES:
        raise FitError(f"{len(t)} samples after the largest deflection, expected at least {MIN_SAMPLES}")
    rate, omega = _search(t, x)
    shapes = _curve(rate, omega, t)
    linear = np.linalg.lstsq(shapes, x, rcond=None)[0]
    noise = max(float(np.median(np.abs(x - shapes @ linear))) * 1.4826, 1e-9)

    def residuals(p: FloatArray) -> FloatArray:
        value: FloatArray = (_curve(p[0], p[1], t) @ p[2:] - x) / noise
        return value

    scale = np.array([omega, omega, *np.full(3, max(float(np.abs(linear).max()), 1e-6))])
    found = least_squares(residuals, [rate, omega, *linear], loss="soft_l1", f_scale=2.0, x_scale=scale)
    rate, omega = float(found.x[0]), float(abs(found.x[1]))
    left = residuals(found.x) * noise
    amplitude = float(np.hypot(found.x[2], found.x[3]))
    residual = float(np.sqrt(np.mean(left**2)))
    if rate <= 0.0 or amplitude < 3.0 * residual or rate > 5.0 * omega:
        raise FitError("no damped oscillation in these readings: is the joint overdamped, or the rate too low?")
    spread = 1.4826 * float(np.median(np.abs(left)))
    jacobian = np.asarray(found.jac, dtype=np.float64)
    information = jacobian.T @ jacobian
    covariance = np.linalg.pinv(information) * max(spread / noise, 1e-12) ** 2
    natural = float(np.hypot(rate, omega))
    ratio = rate / natural
    # zeta = r / sqrt(r^2 + w^2): its gradient in (r, w).
    gradient = np.array([omega**2, -rate * omega]) / natural**3
    ratio_sigma = float(np.sqrt(gradient @ covariance[:2, :2] @ gradient))
    by_decrement = 2.0 * np.pi / (1.0 - ratio**2) ** 1.5
    return Oscillation(
        damping_ratio=ratio,
        damping_ratio_sigma=ratio_sigma,
        decrement=decrement(ratio),
        decrement_sigma=by_decrement * ratio_sigma,
        peak_decrement=peak_decrement(x - found.x[4], spread),
        frequency_hz=omega / (2.0 * np.pi),
        frequency_sigma_hz=float(np.sqrt(covariance[1, 1])) / (2.0 * np.pi),
        natural_rad_s=natural,
        rest_angle=float(found.x[4]),
        residual=residual,
        samples=len(t),
        start_s=float(time[start]),
    )


def peak_decrement(deflection: FloatArray, noise: float) -> float | None:
    """Logarithmic decrement from the highest points of successive half swings.

    Args:
        deflection: shape (m,), rad, about the rest angle.
        noise: standard deviation of a reading, rad.
    """
    bounds = np.flatnonzero(np.diff(np.sign(deflection)) != 0) + 1
    halves = np.split(deflection, bounds)
    peaks = []
    for k, half in enumerate(halves):
        if k == len(halves) - 1 and not _turns(half):
            break
        height = float(np.abs(half).max())
        if height < max(PEAK_OVER_NOISE * noise, 1e-12):
            break
        peaks.append(height)
    # What comes before the first crossing may have been held or cut.
    peaks = peaks[1:] if len(peaks) > 2 else peaks
    if len(peaks) < 2:
        return None
    slope = np.polyfit(np.arange(len(peaks)), np.log(peaks), 1)[0]
    return float(-2.0 * slope)


def _turns(half: FloatArray) -> bool:
    """Whether a half swing at the record's end got over its highest point."""
    return len(half) > 2 and 0 < int(np.argmax(np.abs(half))) < len(half) - 1
