"""Harmonics of relay oscillations, many at once: the same function reads a live record and a batch for training.

    Y_k = 2/(c Pu) int pv e^{-j k w t} dt,   U_k likewise of the output (exact: it is held between samples)
    w = 2 pi/Pu,   k = 1 ... 5,   over the last c whole cycles

In a steady oscillation `Y_k/U_k = G(j k w)` whatever the relay's bias, hysteresis and sampling delay. What is returned
has no unit: harmonics are divided by the fundamental of their signal and turned so that the output's has phase 0.

Invariants: time enters as `t/Pu`, PV as `pv/|Y_1|`, output as `u/|U_1|`, so scales drop out; white noise of
standard deviation `sigma` leaves `noise = sigma sqrt(2/n)/|Y_1|` in each part of a harmonic of `n` samples.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from autotuner.core.signals.limit_cycle import driving_fundamental, relay_switches, replayed, without_chatter

if TYPE_CHECKING:
    from autotuner.core.model.arrays import ComplexArray, FloatArray, IntArray
    from autotuner.core.recording import Recording

HARMONICS = 5
"""Harmonics of the wave that are compared: the fifth of a relay has a fifth of the fundamental's size."""
FEWEST_SWITCHES = 3
"""Fewest switches: one whole period."""
REST = 0.05
"""Smallest distance of the mean output from rest, in relay fundamentals, that shows a gain."""


class RelayWaves(NamedTuple):
    """Oscillations, one an element.

    Attributes
    ----------
    Pu, A1, U1 : array of float, shape (B,)
        Period, s, and fundamentals of PV and output, in their units: the scales.
    y, u : array of complex, shape (B, 5)
        Harmonics of PV and output over their fundamentals, the output's fundamental at phase 0.
    peak, duty, interval, hysteresis : array of float, shape (B,)
        PV amplitude over `A1`; share of the period at the upper level; sample interval over `Pu`; half the distance of
        the PV at the two kinds of switches over `A1`.
    noise : array of float, shape (B,)
        Standard deviation that white noise leaves in a part of a harmonic, over `A1`.
    cycles : array of float, shape (B,)
        Whole cycles read.
    gain, gain_error : array of float, shape (B,)
        Static gain that an asymmetric relay shows, times `U1/A1`, and its standard error; NaN without asymmetry.
    """

    Pu: FloatArray
    A1: FloatArray
    U1: FloatArray
    y: ComplexArray
    u: ComplexArray
    peak: FloatArray
    duty: FloatArray
    interval: FloatArray
    hysteresis: FloatArray
    noise: FloatArray
    cycles: FloatArray
    gain: FloatArray
    gain_error: FloatArray


def cycles_of(switches: int) -> int:
    """Return the number of full cycles to evaluate after so many switches: the later half, after the transient."""
    return max(1, (switches + 1) // 4)


def waves(
    t: FloatArray,
    pv: FloatArray,
    output: FloatArray,
    cycles: int,
    sigma: FloatArray,
    rest: tuple[FloatArray, int],
    response: ComplexArray | None = None,
) -> RelayWaves:
    """Read the rows of a batch; every row begins at a switch and ends at the same kind of switch `cycles` later.

    Parameters
    ----------
    t, pv, output : array of float, shape (B, N)
        Samples, s, PV and output units; a row that ends earlier repeats its last sample.
    cycles : int
        Whole cycles in each row.
    sigma : array of float, shape (B,)
        Standard deviation of the noise, PV.
    rest : (array of float, shape (2, B), int)
        PV and output at rest before the relay, and how many samples were averaged; NaN and 0 where there was none.
    response : array of complex, shape (B,), optional
        Fundamental of the PV over that of the output, from the streaming detector; from the samples without it.
    """
    span = t[:, -1] - t[:, 0]
    Pu = span / cycles
    turn = (t - t[:, :1]) / Pu[:, None]
    step = np.diff(turn, axis=1)
    weights = np.zeros_like(turn)
    weights[:, 1:] += step / 2.0
    weights[:, :-1] += step / 2.0
    mean_pv, mean_output = (weights * pv).sum(axis=1) / cycles, (step * output[:, :-1]).sum(axis=1) / cycles
    Y, U = _harmonics(turn, weights * (pv - mean_pv[:, None]), output, cycles)
    if response is not None:
        Y[0] = response * U[0]
    A1, U1 = np.abs(Y[0]), np.abs(U[0])
    back = np.conj(U[0]) / U1
    y, u = (
        np.stack([c * back ** (k + 1) for k, c in enumerate(parts)], axis=1) / size[:, None]
        for parts, size in ((Y, A1), (U, U1))
    )
    samples = (step > 0.0).sum(axis=1)
    high = output[:, :-1] > (output.max(axis=1) + output.min(axis=1))[:, None] / 2.0
    moved, answered = (mean_output - rest[0][1]) / U1, (mean_pv - rest[0][0]) / A1
    shows = np.abs(moved) > REST
    gain = np.where(shows, answered / np.where(shows, moved, 1.0), math.nan)
    white = sigma / A1
    error = white * np.sqrt(1.0 / max(rest[1], 1) + 1.0 / samples) / np.where(shows, np.abs(moved), math.nan)
    return RelayWaves(
        Pu, A1, U1, y, u,
        peak=_peak(pv, max(1, round(0.02 * samples.mean() / cycles))) / A1,
        duty=(step * high).sum(axis=1) / cycles,
        interval=cycles / samples,
        hysteresis=_at_switches(pv, output) / A1,
        noise=white * np.sqrt(2.0 / samples),
        cycles=np.full(A1.size, float(cycles)),
        gain=gain,
        gain_error=error,
    )  # fmt: skip


def _harmonics(
    turn: FloatArray, weighted: FloatArray, output: FloatArray, cycles: int
) -> tuple[list[ComplexArray], list[ComplexArray]]:
    """Return the harmonics of PV (weighted samples, mean removed) and of the held output, each of shape (B,)."""
    once = np.exp(-2j * math.pi * turn)
    Y, U, power = [], [], np.ones_like(once)
    for k in range(1, HARMONICS + 1):
        power = power * once
        Y.append((weighted * power).sum(axis=1) * 2.0 / cycles)
        moved = np.diff(power, axis=1)
        # In place: NumPy does this automatically, except while another holder, such as a profiler, keeps the result of
        # `diff`; the product would then lie elsewhere in memory, and its sum would differ in the last bits.
        moved *= output[:, :-1]
        U.append(moved.sum(axis=1) * 1j / (math.pi * k * cycles))
    return Y, U


def wave_of(recording: Recording, sigma: float, sign: float = 1.0) -> RelayWaves | None:
    """Return the oscillation that a recording ends in, a batch of one; None before the third switch or without a swing.

    Parameters
    ----------
    recording : Recording
        Samples so far.
    sigma : float
        Standard deviation of the noise, PV.
    sign : float
        Sign of the process's gain: one of negative gain is read upside down.
    """
    switches = without_chatter(recording.t, relay_switches(recording.output, FEWEST_SWITCHES))
    if switches.size < FEWEST_SWITCHES:
        return None
    cycles = cycles_of(switches.size)
    rows = slice(int(switches[-2 * cycles - 1]), int(switches[-1]) + 1)
    pv = math.copysign(1.0, sign) * recording.pv
    rest = _rest(pv, recording.output)
    t, seen, output = (column[None, rows] for column in (recording.t, pv, recording.output))
    watched = replayed(recording.t, pv, recording.output, switches)[-2 * cycles + 1 :: 2]
    response = np.mean([cycle.phasor for cycle in watched]) / driving_fundamental(
        recording, switches[-2 * cycles - 1 :]
    )
    wave = waves(t, seen, output, cycles, np.array([sigma]), rest, np.array([response]))
    return wave if wave.peak[0] > 0.0 else None


def process_sign(recording: Recording) -> float:
    """Return the sign of the gain of a process that a relay makes oscillate: at half a turn of lag, or at none."""
    wave = wave_of(recording, 0.0)
    return 1.0 if wave is None or float(wave.y[0, 0].real) < 0.0 else -1.0


def _rest(pv: FloatArray, output: FloatArray) -> tuple[FloatArray, int]:
    """Return PV and output before the first change of the output, and the number of samples."""
    last = int(np.flatnonzero(np.diff(output))[0])
    return np.array([[pv[: last + 1].mean()], [output[0]]]), last + 1


def _peak(pv: FloatArray, half_width: int) -> FloatArray:
    """Return half the swing of the moving mean."""
    sums = np.cumsum(np.pad(pv, ((0, 0), (1, 0))), axis=1)
    width = min(2 * half_width + 1, pv.shape[1])
    means = (sums[:, width:] - sums[:, :-width]) / width
    swing: FloatArray = (means.max(axis=1) - means.min(axis=1)) / 2.0
    return swing


def _at_switches(pv: FloatArray, output: FloatArray) -> FloatArray:
    """Return half the distance of the mean PV at the falls and at the rises of the output."""
    change = np.diff(output, axis=1)
    at: FloatArray = pv[:, 1:]
    rises: IntArray = (change > 0.0).astype(np.int64)
    falls: IntArray = (change < 0.0).astype(np.int64)
    means = [(at * kind).sum(axis=1) / np.maximum(kind.sum(axis=1), 1) for kind in (falls, rises)]
    both = (rises.sum(axis=1) > 0) & (falls.sum(axis=1) > 0)
    distance: FloatArray = np.where(both, np.abs(means[0] - means[1]) / 2.0, 0.0)
    return distance
