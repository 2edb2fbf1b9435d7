"""A loop at rest: its noise, drift, resolution and sampling.

    s         = 1.4826 median |d - median d|,  d = pv[k+1] - pv[k]               (robust, blind to drift)
    sigma     = standard deviation of all d within 4 s of the median / sqrt(2)   (of 50 samples to 12 %; s to 18 %)
    slope     = least-squares line through pv, with its standard error
    resolution= smallest step between two different values
    spread    = standard deviation about that line
    error     = sqrt(residual variance / power * (1 + r)/(1 - r)),  r lag-one correlation of the residuals, 0 at least
    jitter    = largest deviation of a sample interval from the median interval

With coloured noise neighbouring readings are correlated: a line through N of them is as uncertain as one through
N (1 - r)/(1 + r) independent ones (Bartlett, J. R. Stat. Soc. 98, 1935), and `sigma`, from differences, is too
small for the wander of the PV; `disturbance_sigma` is the larger one where they clearly differ.

`sigma` PV, `slope` PV/s. Where most differences vanish (a quantised or report-on-change sensor) the root mean square
of the differences takes the place of the median. A sensor without any change over the whole time has sigma 0 and
counts as noise-free, not as broken: only the response to the relay can reveal a broken sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotuner.core.model.arrays import FloatArray  # noqa: TC001 - part of the public signature
from autotuner.core.signals.noise import MAD_TO_SIGMA

WILD = 5.0
"""Outlier limit of a sample at rest, robust standard deviations from the median: 6e-7 of normal samples exceed it."""
UNLIKELY_Z = -1.6448536269514722
"""5 % quantile of the normal distribution, at which the noise is stated: an upper bound at 95 %."""
LEAST = 3
"""Fewest samples of a standard deviation."""
KEPT = 4.0
"""Differences that count for the noise, in robust standard deviations of them."""
ROUNDING = 1e-6
"""Share of the PV under which a travel is arithmetic, not physics."""
ARITHMETIC = 16.0 * float(np.finfo(np.float64).eps)
"""Share of the PV under which a spread is rounding of the line through a PV that does not move, not noise."""
COLOURED = 1.5
"""Spread over the noise of differences from which a PV wanders more than its neighbouring readings show."""
MOST_ALIKE = 0.98
"""Largest correlation of neighbouring readings that is accepted."""
FEWEST_FOR_COLOUR = 20
"""Fewest readings at rest whose correlation says something."""
SIGNIFICANT_COLOUR = 2.0
"""Lag-one correlation, in its standard errors `1/sqrt(N)`, from which noise counts as coloured."""


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
    spread : float
        Standard deviation about the line, PV units.
    """

    pv: float
    noise_sigma: float
    drift_per_s: float
    drift_error_per_s: float
    resolution: float
    sample_interval_s: float
    jitter_s: float
    duration_s: float
    spread: float = 0.0

    @property
    def disturbance_sigma(self) -> float:
        """Standard deviation of all that moves the PV at rest, slow noise included, PV units."""
        return self.spread if self.spread > COLOURED * self.noise_sigma else self.noise_sigma

    @property
    def pv_error(self) -> float:
        """Standard error of the median PV, PV units."""
        samples = 1.0 + self.duration_s / self.sample_interval_s
        return self.noise_sigma * math.sqrt(math.pi / 2.0 / samples)

    @property
    def unsure(self) -> float:
        """Largest deviation of a reading from the PV: noise, or half a resolution step where larger, PV units."""
        return max(self.noise_sigma, self.resolution / 2.0)

    @property
    def drifts(self) -> bool:
        """Whether the PV moves by more than its noise and resolution explain, over the time it was watched."""
        travelled = abs(self.drift_per_s) * self.duration_s
        significant = abs(self.drift_per_s) > 4.0 * self.drift_error_per_s
        return significant and travelled > max(
            3.0 * self.noise_sigma, 2.0 * self.spread, 2.0 * self.resolution, ROUNDING * abs(self.pv)
        )


def measure_quiet(t: FloatArray, pv: FloatArray) -> QuietMeasurement:
    """Measure noise, drift, resolution and sampling of a loop with constant output.

    Parameters
    ----------
    t, pv : array of float, shape (N,), N >= 3
        Samples, s and PV units.
    """
    steps = np.abs(np.diff(pv))
    intervals = np.diff(t)
    interval = float(np.median(intervals))
    slope, slope_error, spread = _line(t, pv)
    return QuietMeasurement(
        pv=float(np.median(pv)),
        noise_sigma=_noise_sigma(np.diff(pv)),
        drift_per_s=slope,
        drift_error_per_s=slope_error,
        resolution=float(steps[steps > 0.0].min()) if (steps > 0.0).any() else 0.0,
        sample_interval_s=interval,
        jitter_s=float(np.abs(intervals - interval).max()),
        duration_s=float(t[-1] - t[0]),
        spread=spread,
    )


def largest_noise(pv: FloatArray) -> float:
    """Return the upper end of the 95 % interval of the noise's standard deviation, PV units.

        s sqrt((N - 1)/chi2),   chi2 the 5 % quantile for N - 1 samples

    `s` is the standard deviation of all but wild samples. What noise is feared must not be taken too small: of 60
    samples the one of `measure_quiet` may be a third under the truth. The quantile is that of Wilson and Hilferty
    (Proc. Natl. Acad. Sci. 17, 1931): within 0.2 % of the exact one from 12 samples on, and smaller, which is the safe
    side, for fewer.

        chi2/n = (1 - 2/(9 n) + z sqrt(2/(9 n)))^3,   n = N - 1, z = -1.645

    Parameters
    ----------
    pv : array of float, shape (N,), N >= 3
        A loop at rest, PV units.
    """
    samples = without_wild(pv)
    if samples.size < LEAST:
        return 0.0
    return float(np.std(samples, ddof=1)) / math.sqrt(_unlikely_quantile(samples.size - 1.0))


def largest_wander(t: FloatArray, pv: FloatArray) -> float:
    """Return the upper end of the 95 % interval of coloured noise at rest, PV units; 0 where the noise is white.

        M = N (1 - r^2)/(1 + r^2),   r = (N r' + 2)/(N - 4)

    A standard deviation of `N` readings with lag-one correlation `r` is known as well as one of `M` independent ones
    (Bartlett, J. R. Stat. Soc. 98, 1935); `r'`, the correlation about a line, is too small by `(2 + 4 r)/N` on average
    (Kendall, Biometrika 41, 1954). Noise counts as coloured from two standard errors of `r'`, `2/sqrt(N)`, on. Wild
    samples are left out: a load that comes at the end of the rest is no noise.

    Parameters
    ----------
    t, pv : array of float, shape (N,)
        Samples of a loop at rest, s and PV units.
    """
    if t.size >= FEWEST_FOR_COLOUR and np.ptp(tame := without_wild(pv)) > 0.0:
        t, pv = t[np.isin(pv, tame)], tame
    if t.size < FEWEST_FOR_COLOUR:
        return 0.0
    left = pv - np.polyval(np.polyfit(t - t[0], pv, 1), t - t[0])
    power = float(left @ left)
    if math.sqrt(power / t.size) <= ARITHMETIC * float(np.abs(pv).max()):
        return 0.0
    alike = float(left[1:] @ left[:-1]) / power
    if alike <= SIGNIFICANT_COLOUR / math.sqrt(t.size):
        return 0.0
    alike = min((t.size * alike + 2.0) / (t.size - 4.0), MOST_ALIKE)
    independent = max(t.size * (1.0 - alike**2) / (1.0 + alike**2), LEAST)
    return math.sqrt(power / (t.size - 2)) / math.sqrt(_unlikely_quantile(independent - 1.0))


def without_wild(values: FloatArray) -> FloatArray:
    """Return all but the wild samples: no number, or `WILD` robust standard deviations away from the median."""
    finite: FloatArray = values[np.isfinite(values)]
    distance = np.abs(finite - np.median(finite))
    inliers: FloatArray = finite[distance <= WILD * MAD_TO_SIGMA * np.median(distance)]
    return inliers


def _unlikely_quantile(n: float) -> float:
    """Return the 5 % quantile of `chi2/n` for `n` degrees of freedom."""
    spread = 2.0 / (9.0 * n)
    return float((1.0 - spread + UNLIKELY_Z * math.sqrt(spread)) ** 3)


def _noise_sigma(differences: FloatArray) -> float:
    distance = np.abs(differences - np.median(differences))
    spread = MAD_TO_SIGMA * float(np.median(distance))
    if spread == 0.0 or np.mean(differences == 0.0) > 0.25:
        return float(np.sqrt(np.mean(differences**2) / 2.0))
    return float(np.std(differences[distance <= KEPT * spread])) / math.sqrt(2.0)


def _line(t: FloatArray, pv: FloatArray) -> tuple[float, float, float]:
    """Return slope, its standard error, and the standard deviation about the line."""
    centred = t - t.mean()
    power = float(centred @ centred)
    slope = float(centred @ pv) / power
    residual = pv - pv.mean() - slope * centred
    variance = float(residual @ residual) / max(t.size - 2, 1)
    alike = float(residual[1:] @ residual[:-1]) / float(residual @ residual) if variance > 0.0 else 0.0
    alike = min(max(alike, 0.0), MOST_ALIKE)
    spread = math.sqrt(variance)
    is_rounding = spread <= ARITHMETIC * float(np.abs(pv).max())
    return slope, spread * math.sqrt((1.0 + alike) / (1.0 - alike) / power), 0.0 if is_rounding else spread
