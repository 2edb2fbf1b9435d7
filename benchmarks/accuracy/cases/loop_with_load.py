"""A PI loop that a load moves besides the set point; the load is not in the record."""

import numpy as np

from autotuner import Recording
from autotuner_sim.plants import Fopdt
from autotuner_sim.stepped import SteppedPlant

SET_POINT = (0.0, 2.0, 0.0, -2.0, 1.0)
LASTS_S, NOISE = 20.0, 0.03
"""Correlation time of the load, s, and noise of the sensor, PV."""


def loop_with_load(seed, *, gain=1.5, lag_s=15.0, dead_time_s=5.0, size=1.1, rows=1500, set_point=SET_POINT):
    """Return the record, one sample a second, and what the load alone makes of the PV.

    The load enters with the output, without its dead time, and has a standard deviation of `size` PV. The controller
    has the integral time 20 s, and a gain of 1.8 over that of the process.
    """
    rng = np.random.default_rng(seed)
    answer, loaded = (SteppedPlant(Fopdt(gain, lag_s, D)) for D in (dead_time_s, 0.0))
    load = integral = 0.0
    kept = np.exp(-1.0 / LASTS_S)
    u, pv, by_load, sp = np.zeros(rows), np.zeros(rows), np.zeros(rows), np.repeat(set_point, rows // len(set_point))
    for k in range(rows):
        answer.advance(float(k))
        loaded.advance(float(k))
        by_load[k] = loaded.pv
        pv[k] = answer.pv + loaded.pv + rng.normal(0.0, NOISE)
        error = sp[k] - pv[k]
        integral += error / 20.0
        u[k] = 1.8 / gain * (error + integral)
        load = kept * load + rng.normal(0.0, size * np.sqrt(1.0 - kept**2))
        answer.output, loaded.output = float(u[k]), load / gain
    return Recording(np.arange(float(rows)), 50.0 + u, 100.0 + pv, 100.0 + sp), by_load
