"""Sampled relay experiments on many processes at once, exact between samples, with noise in the loop.

    x[k+1] = Phi x[k] + Gamma u[k-n] + Delta (u[k-n-1] - u[k-n]),   D/dt = n + f,   Delta = Phi(1-f) Gamma(f)

The relay reads the noisy PV at each sample and holds its level to the next. Time runs in samples: only ratios of times
matter. The law of each step is the zero-order-hold response (Astrom and Wittenmark, Computer-Controlled Systems, 3.2);
`tests/models` holds it against `autotuner_sim.SteppedPlant`.

K PV/output, times in samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import expm

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Numbers = NDArray[np.float64]
    Rows = NDArray[np.intp]

ON_SIGMA = 3.0
"""Least dead zone of a relay under noise, half width, in its standard deviations: half the switches are then not the
noise's."""


class Processes(NamedTuple):
    """Processes `b/(a0 + a1 s + a2 s^2) e^{-Ds}`, one an element; first order where `a2 = 0`."""

    b: Numbers
    a0: Numbers
    a1: Numbers
    a2: Numbers
    D: Numbers


@dataclass(frozen=True, slots=True, eq=False)
class Relays:
    """The relay of each experiment: levels (output), half width of the dead zone (PV), noise of the PV."""

    low: Numbers
    high: Numbers
    hysteresis: Numbers
    sigma: Numbers


@dataclass(frozen=True, slots=True, eq=False)
class Records:
    """Recorded experiments.

    Attributes
    ----------
    pv, output : array of float, shape (N, B)
        Samples; the relay is switched on to its upper level at row 0.
    switches : array of int, shape (S, B)
        Rows of the switches after that; -1 where there are fewer.
    """

    pv: Numbers
    output: Numbers
    switches: Rows


def run(processes: Processes, relays: Relays, switches: int, samples: int, rng: np.random.Generator) -> Records:
    """Run all experiments from rest up to the given number of switches or samples."""
    count = processes.b.size
    phi, gamma, delta, whole = _steps(processes)
    depth = int(whole.max()) + 2
    past, everyone = np.zeros((depth, count)), np.arange(count)
    pvs, outputs = np.empty((samples, count)), np.empty((samples, count))
    rows = np.full((switches, count), -1, dtype=np.intp)
    x, y, is_high, switched = np.zeros(count), np.zeros(count), np.ones(count, dtype=np.bool_), np.zeros(count, np.intp)
    middle, half = (relays.high + relays.low) / 2.0, (relays.high - relays.low) / 2.0
    noise = rng.standard_normal((samples, count)) * relays.sigma
    k = 0
    for k in range(samples):
        pv = y + noise[k]
        switching = np.where(is_high, pv > relays.hysteresis, pv < -relays.hysteresis) & (k > 0)
        is_high ^= switching
        now = np.flatnonzero(switching & (switched < switches))
        rows[switched[now], now] = k
        switched += switching
        output = np.where(is_high, middle + half, middle - half)
        pvs[k], outputs[k] = pv, output
        past[k % depth] = output
        if k % 32 == 0 and switched.min() >= switches:
            break
        new, old = past[(k - whole) % depth, everyone], past[(k - whole - 1) % depth, everyone]
        x, y = (
            phi[0] * x + phi[1] * y + gamma[0] * new + delta[0] * (old - new),
            phi[2] * x + phi[3] * y + gamma[1] * new + delta[1] * (old - new),
        )
    return Records(pvs[: k + 1], outputs[: k + 1], rows)


def _steps(processes: Processes) -> tuple[Numbers, Numbers, Numbers, Rows]:
    """Return `Phi` (4, B), `Gamma` (2, B), `Delta` (2, B) and the whole samples of dead time; state (slope, PV)."""
    b, a0, a1, a2, D = processes
    first = a2 == 0.0
    whole = np.floor(D).astype(np.intp)
    f = D - whole
    lead = np.where(first, 1.0, a2)
    A = np.zeros((b.size, 3, 3))
    A[:, 0, 0], A[:, 0, 1], A[:, 0, 2] = -a1 / lead, -a0 / lead, b / lead
    A[:, 1, 0] = 1.0
    A[first, 0, :] = 0.0
    A[first, 1, 0], A[first, 1, 1], A[first, 1, 2] = 0.0, -(a0 / a1)[first], (b / a1)[first]
    full, part, rest = (expm(A * span[:, None, None]) for span in (np.ones_like(f), f, 1.0 - f))
    delta = np.einsum("bij,bj->ib", rest[:, :2, :2], part[:, :2, 2])
    phi = full[:, :2, :2].reshape(-1, 4).T
    return np.ascontiguousarray(phi), np.ascontiguousarray(full[:, :2, 2].T), np.ascontiguousarray(delta), whole
