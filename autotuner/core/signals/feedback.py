"""Detects whether a recorded output was a controller's, and the direction of its action.

A controller passes the noise of the PV on to its output in the same sample; an independent output is not correlated
with the noise. Second differences contain little but noise, so

    r = correlation of d2 output and d2 PV,   d2 x_k = x_{k+1} - 2 x_k + x_{k-1}

is near -1 under a controller that lowers the output when the PV rises, near +1 under one that raises it, and near 0
without a controller. It counts only where the second differences of the PV are noise: those of white noise have the
autocorrelation -2/3 at lag one, those of a smooth signal one near 1.

A controller with negative feedback reveals the sign of the process's gain, the opposite of its own. That
excludes the spurious solution of every closed-loop fit, the inverse of the controller, `G = -1/C`.

A relay passes no noise on. It switches up where the PV is low and down where it is high if the process has a positive
gain, whatever lies between the relay and the process; the response to its first move must agree.
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
LARGE, FEWEST = 0.4, 4
"""Share of the largest move from which one is a switch of a relay, and fewest switches of either kind."""


def moves_all_the_time(recording: Recording) -> bool:
    """Return whether the output moves with most samples, as a controller's does."""
    return float(np.mean(np.diff(recording.output) != 0.0)) >= FOLLOWS


def set_point_moves(recording: Recording) -> bool:
    """Return whether the set point is recorded, and changes."""
    known = np.zeros(1) if recording.set_point is None else recording.set_point[np.isfinite(recording.set_point)]
    return bool(np.unique(known).size > 1)


def is_kept_at_set_point(recording: Recording) -> bool:
    """Return whether the PV is nearer to a recorded set point than the output is: a controller keeps it there."""
    set_point = recording.set_point
    if set_point is None or not np.isfinite(set_point).any():
        return False
    pv_off, output_off = (float(np.nanmean(np.abs(x - set_point))) for x in (recording.pv, recording.output))
    return pv_off < output_off


def process_sign(recording: Recording) -> int:
    """Return the sign of the process's gain as a controller in the record shows it: 1, -1, or 0 for none."""
    if len(recording) < 5:
        return 0
    if not moves_all_the_time(recording):
        return _sign_by_relay(recording)
    output, pv = (x - x.mean() for x in (np.diff(recording.output, 2), np.diff(recording.pv, 2)))
    power = float(pv @ pv)
    size = np.sqrt(power * float(output @ output))
    if size == 0.0 or float(pv[1:] @ pv[:-1]) > NOISE_LIKE * power:
        return 0
    r = float(output @ pv) / size
    return int(-np.sign(r)) if abs(r) > PASSED_ON else 0


def _sign_by_relay(recording: Recording) -> int:
    moves, pv = np.diff(recording.output), recording.pv
    at = np.flatnonzero(np.abs(moves) > LARGE * np.abs(moves).max())
    switches = at[1:][np.sign(moves[at[1:]]) == -np.sign(moves[at[:-1]])]
    ups, downs = (pv[switches[moves[switches] * direction > 0.0] + 1] for direction in (1.0, -1.0))
    if min(ups.size, downs.size) < FEWEST:
        return 0
    sign = int(ups.max() < downs.min()) - int(ups.min() > downs.max())
    first, following = np.flatnonzero(moves)[:2]
    response = (pv[following + 1] - pv[: first + 1].mean()) * moves[first]
    return sign if sign * response > 0.0 else 0
