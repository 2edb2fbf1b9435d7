"""What a PID loop does on a process of the batch: sensitivities, stability, integrated error.

Independent of the package: nothing is imported from it.

The error after a load step is inverted from its Laplace transform on a line right of the axis, with Euler's summation
(Abate and Whitt, ORSA J. Computing 7, 1995), not from the frequency response, on which the package's own design rests.
"""

import math

import numpy as np

EULER_TERMS, EULER_AVERAGED = 24, 12
EULER_SHIFT = 18.4
TIMES = np.geomspace(1e-3, 1e2, 340)
FREQUENCIES = np.concatenate((np.geomspace(1e-4, 1e4, 1600), np.linspace(0.02, 40.0, 2000)))
FREQUENCIES.sort()


def controller(s, Kp, Ti, Td, Tf):
    return Kp * (1.0 + 1.0 / (s * Ti) + s * Td) / (1.0 + s * Tf + (s * Tf) ** 2 / 2.0)


def sensitivities(process, gains, Pu, grid=FREQUENCIES):
    """Return `Ms`, `Mt`, stable."""
    w = grid * 2.0 * math.pi / Pu
    L = controller(1j * w, *gains) * process(1j * w)
    f = 1.0 + L
    S = 1.0 / f
    return float(np.abs(S).max()), float(np.abs(L * S).max()), bool(is_stable(f, process.integrators))


def is_stable(f, integrators):
    """Return whether `1 + L`, frequencies along the last axis, turns about 0 as that of a stable loop."""
    turns, q = np.unwrap(np.angle(f), axis=-1), 1 + integrators
    begin = -q * math.pi / 2.0
    begin = begin + np.round((turns[..., 0] - begin) / (2.0 * math.pi)) * 2.0 * math.pi
    end = np.round(turns[..., -1] / (2.0 * math.pi)) * 2.0 * math.pi
    return (np.round((end - begin) / math.pi - q / 2.0) == 0.0) & (np.abs(turns[..., -1] - end) < 1.5)


def load_error(process, gains, t):
    """Return the PV at `t + D` after a unit load step at the process input."""
    k = np.arange(EULER_TERMS + EULER_AVERAGED + 1)
    s = (EULER_SHIFT + 2j * math.pi * k[None, :]) / (2.0 * t[:, None])
    G0 = process.undelayed(s)
    E = (G0 / (s * (1.0 + controller(s, *gains) * G0 * np.exp(-s * process.D)))).real
    signs = (-1.0) ** k
    signs[0] = 0.5
    partial = np.cumsum(E * signs, axis=1)[:, EULER_TERMS:]
    binomial = np.array([math.comb(EULER_AVERAGED, j) for j in range(EULER_AVERAGED + 1)]) / 2.0**EULER_AVERAGED
    return math.exp(EULER_SHIFT / 2.0) / t * (partial @ binomial)


def iae(process, gains, Pu):
    """Return the integral of the absolute error after a unit load step; at least `Ti/Kp`, the integral of the error."""
    t = TIMES * Pu
    e = load_error(process, gains, t)
    size = np.abs(np.concatenate(([0.0], e)))
    return max(float(np.trapezoid(size, np.concatenate(([0.0], t)))), gains[1] / gains[0])
