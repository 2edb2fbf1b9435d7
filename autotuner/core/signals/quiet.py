"""What a loop at rest tells: noise, drift, resolution, sampling.

    s         = 1.4826 median |d - median d|,  d = pv[k+1] - pv[k]               (robust, blind to drift)
    sigma     = standard deviation of all d within 4 s of the median / sqrt(2)   (of 50 samples to 12 %; s to 18 %)
    slope     = least-squares line through pv, with its standard error
    resolution= smallest step between two different values
    jitter    = largest deviation of a sample interval from the median interval

`sigma` PV, `slope` PV/s. Where most differences vanish (a quantised or report-on-change sensor) the root mean square
of the differences takes the place of the median. A sensor without any change over the whole time has sigma 0 and
counts as noise-free, not as broken: only the answer to the relay can tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from autotuner.core.arrays import FloatArray  # noqa: TC001 - part of the public signature
from autotuner.core.signals.noise import MAD_TO_SIGMA

WILD = 5.0
UNLIKELY = 0.05
LEAST = 3
KEPT = 4.0
"""Differences that count for the noise, in robust standard deviations of them."""
ROUNDING = 1e-6
"""Share of the PV under which a travel is arithmetic, not physics."""


@dataclass(frozen=True, slots=True)
class QuietMeasurement:
    """A loop at rest.

    Attributes
    ----------
    pv : float
        Median PV, PV units.
    noise_sigma : float
        Standard deviation of the measurement noise, PV units.
    drift_per_s, drift_error_per_s : float
        Slope of the PV and its standard error, PV/s.
    resolution : float
        Smallest step seen between two values, PV units; 0 when the PV did not change.
    sample_interval_s, jitter_s : float
        Median interval between samples, and its largest deviation, s.
    duration_s : float
        Length of the measurement, s.
    """

    pv: float
    noise_sigma: float
    drift_per_s: float
    drift_error_per_s: float
    resolution: float
    sample_interval_s: float
    jitter_s: float
    duration_s: float

    @property
    def pv_error(self) -> float:
        """Standard error of the median PV, PV units."""
        samples = 1.0 + self.duration_s / self.sample_interval_s
        return self.noise_sigma * math.sqrt(math.pi / 2.0 / samples)

    @property
    def unsure(self) -> float:
        """How far a reading may be from the PV: noise, or half a step of the sensor where that is more, PV units."""
        return max(self.noise_sigma, self.resolution / 2.0)

    @property
    def drifts(self) -> bool:
        """Whether the PV moves by more than its noise and resolution explain, over the time it was watched."""
        travelled = abs(self.drift_per_s) * self.duration_s
        significant = abs(self.drift_per_s) > 4.0 * self.drift_error_per_s
        return significant and travelled > max(3.0 * self.noise_sigma, 2.0 * self.resolution, ROUNDING * abs(self.pv))


def measure_quiet(t: FloatArray, pv: FloatArray) -> QuietMeasurement:
    """Measure noise, drift, resolution and sampling of a loop whose output is held.

    Parameters
    ----------
    t, pv : array of float, shape (N,), N >= 3
        Samples, s and PV units.
    """
    steps = np.abs(np.diff(pv))
    intervals = np.diff(t)
    interval = float(np.median(intervals))
    slope, slope_error = _line(t, pv)
    return QuietMeasurement(
        pv=float(np.median(pv)),
        noise_sigma=_noise_sigma(np.diff(pv)),
        drift_per_s=slope,
        drift_error_per_s=slope_error,
        resolution=float(steps[steps > 0.0].min()) if (steps > 0.0).any() else 0.0,
        sample_interval_s=interval,
        jitter_s=float(np.abs(intervals - interval).max()),
        duration_s=float(t[-1] - t[0]),
    )


def largest_noise(pv: FloatArray) -> float:
    """Return the upper end of the 95 % interval of the noise's standard deviation, PV units.

        s sqrt((N - 1)/chi2),   chi2 the 5 % quantile for N - 1 samples

    `s` is the standard deviation of all but wild samples, those `WILD` robust ones away from the median. What noise is
    feared must not be taken too small: of 60 samples the one of `measure_quiet` may be a third under the truth.

    Parameters
    ----------
    pv : array of float, shape (N,), N >= 3
        A loop at rest, PV units.
    """
    away = np.abs(pv - np.median(pv))
    kept = pv[away <= WILD * MAD_TO_SIGMA * np.median(away)]
    if kept.size < LEAST:
        return 0.0
    quantile = float(scipy.stats.chi2.ppf(UNLIKELY, kept.size - 1))
    return float(np.std(kept, ddof=1)) * math.sqrt((kept.size - 1) / quantile)


def _noise_sigma(differences: FloatArray) -> float:
    away = np.abs(differences - np.median(differences))
    spread = MAD_TO_SIGMA * float(np.median(away))
    if spread == 0.0 or np.mean(differences == 0.0) > 0.25:
        return float(np.sqrt(np.mean(differences**2) / 2.0))
    return float(np.std(differences[away <= KEPT * spread])) / math.sqrt(2.0)


def _line(t: FloatArray, pv: FloatArray) -> tuple[float, float]:
    """Return slope and its standard error."""
    centred = t - t.mean()
    power = float(centred @ centred)
    slope = float(centred @ pv) / power
    left = pv - pv.mean() - slope * centred
    return slope, float(np.sqrt(left @ left / max(t.size - 2, 1) / power))
