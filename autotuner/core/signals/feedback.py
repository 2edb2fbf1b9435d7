"""Whether a recorded output was a controller's, and which way that controller acts.

A controller passes the noise of the PV on to its output in the same sample; what comes from elsewhere does not know
that noise. Second differences show little but noise, so

    r = correlation of d2 output and d2 PV,   d2 x_k = x_{k+1} - 2 x_k + x_{k-1}

is near -1 under a controller that lowers the output when the PV rises, near +1 under one that raises it, and near 0
without a controller. It counts only where the second differences of the PV are noise: those of white noise have the
autocorrelation -2/3 at lag one, those of a smooth signal one near 1.

A controller that holds a loop by negative feedback tells the sign of the process's gain: the opposite of its own. That
rules out the one solution which every closed loop offers to a fit, the controller's own inverse, `G = -1/C`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from autotuner.core.recording import Recording

FOLLOWS = 0.5
"""Share of samples at which a controller's output moves; less for a relay, steps or a random binary sequence."""
PASSED_ON = 0.5
"""Correlation from which the output carries the noise of the PV."""
NOISE_LIKE = 0.2
"""Autocorrelation at lag one up to which second differences are taken for noise."""


def moves_all_the_time(recording: Recording) -> bool:
    """Return whether the output moves with most samples, as a controller's does."""
    return float(np.mean(np.diff(recording.output) != 0.0)) >= FOLLOWS


def process_sign(recording: Recording) -> int:
    """Return the sign of the process's gain as a controller in the record shows it: 1, -1, or 0 for none."""
    if len(recording) < 5 or not moves_all_the_time(recording):
        return 0
    output, pv = (x - x.mean() for x in (np.diff(recording.output, 2), np.diff(recording.pv, 2)))
    power = float(pv @ pv)
    size = np.sqrt(power * float(output @ output))
    if size == 0.0 or float(pv[1:] @ pv[:-1]) > NOISE_LIKE * power:
        return 0
    r = float(output @ pv) / size
    return int(-np.sign(r)) if abs(r) > PASSED_ON else 0
