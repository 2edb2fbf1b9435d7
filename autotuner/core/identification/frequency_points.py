"""Points of the frequency response from an oscillation under a relay, whatever the structure of the process.

    G(j k w) = G0(j k w) + R_k/U_k,   w = 2 pi/Pu,   k = 1, 2, 3, ...

    u(t) ~ sum_k Re(U_k e^{j k w t})                         exact: the output is constant between its changes
    pv(t) - pv0(t) = sum_k Re(R_k e^{j k w t}) + offset + drift t + bend t^2 + noise       least squares, whole cycles

`G0` a model and `pv0` its simulation on the record. A relay is a square wave, so it contains every odd harmonic, `1/k`
of the fundamental, and an asymmetric one the even ones too. (Wang, Lee and Lin, Relay Feedback, 2003, ch. 3.)
`R_k` contains the difference to the model, so the points do not depend on its structure; the model only removes the
errors by unequal cycles, by the initial transient, and by aliasing of the sampled wave, which
`pv0` contains as the record does. Their errors are those of `R_k`, not of the model. `G` PV/output, `w` rad/s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.process import frequency_response
from autotuner.core.signals.noise import inflation, resolution

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner.core.signals.limit_cycle import LimitCycle

HIGHEST, MOST_FITTED = 9, 25
"""Harmonics that are reported, and that are fitted, at most."""
SAMPLES_REPORTED, SAMPLES_FITTED = 8.0, 3.0
"""Samples in a period of the highest harmonic that is reported, and fitted, at least."""
SMALLEST_DRIVE = 0.02
"""Share of the fundamental under which the relay does not drive a harmonic."""
TOO_VAGUE = 0.3
"""Standard error, relative to the point and to the model's own, above which it is not given."""


@dataclass(frozen=True, slots=True)
class FrequencyPoint:
    """One point of the frequency response.

    Attributes
    ----------
    harmonic : int
        Which harmonic of the oscillation.
    w : float
        Frequency, rad/s.
    G : complex
        Response, PV/output.
    standard_error : float
        Of its real and of its imaginary part, PV/output; over `|G|` it is the error of the phase, rad.
    """

    harmonic: int
    w: float
    G: complex
    standard_error: float

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "harmonic": self.harmonic,
            "w_rad_s": self.w,
            "real": self.G.real,
            "imag": self.G.imag,
            "gain": abs(self.G),
            "phase_deg": math.degrees(math.atan2(self.G.imag, self.G.real)),
            "standard_error": self.standard_error,
        }


def frequency_points(
    recording: Recording, cycle: LimitCycle, model: ProcessModel, simulated: FloatArray
) -> tuple[FrequencyPoint, ...]:
    """Return the points that a steady oscillation shows, the fundamental first.

    Parameters
    ----------
    recording : Recording
        The recording.
    cycle : LimitCycle
        Its oscillation; with a parallel controller too, the output is the total command.
    model : ProcessModel
        A model of the process, however rough.
    simulated : array of float, shape (N,)
        PV that it gives on the recording.
    """
    changes = np.flatnonzero(np.diff(recording.output)) + 1
    acts_s = recording.acts_s[changes]
    start_s, end_s = (float(acts_s[np.argmin(np.abs(acts_s - t))]) for t in (cycle.start_s, cycle.end_s))
    w = 2.0 * math.pi * cycle.cycles / (end_s - start_s)
    rows = (recording.t >= start_s) & (recording.t < end_s)
    t, left = recording.t[rows] - start_s, (recording.pv - simulated)[rows]
    a_period = t.size / cycle.cycles
    fitted = np.arange(1, min(int(a_period / SAMPLES_FITTED), MOST_FITTED) + 1)
    if fitted.size < 1 or t.size < 4 * fitted.size:
        return ()
    U = _driving(recording, start_s, end_s, w, fitted)
    driven = np.abs(U) > SMALLEST_DRIVE * abs(U[0])
    if not driven[0]:
        return ()
    R, error = _harmonics(t, left, w, fitted, resolution(recording.pv))
    k, U, R, error = fitted[driven], U[driven], R[driven], error[driven]
    G0 = frequency_response(model, w * k.astype(np.float64))
    G, error = G0 + R / U, error / np.abs(U)
    known = (k <= min(a_period / SAMPLES_REPORTED, HIGHEST)) & (error <= TOO_VAGUE * np.minimum(np.abs(G0), np.abs(G)))
    return tuple(
        FrequencyPoint(int(k[i]), float(k[i] * w), complex(G[i]), float(error[i])) for i in np.flatnonzero(known)
    )


def _harmonics(
    t: FloatArray, values: FloatArray, w: float, k: np.ndarray, step: float
) -> tuple[np.ndarray, FloatArray]:
    """Return complex amplitudes of the harmonics and the standard errors of their parts."""
    angle = np.outer(t, k * w)
    x = 2.0 * t / t[-1] - 1.0
    phi = np.column_stack((np.cos(angle), -np.sin(angle), np.ones_like(t), x, x**2))
    found, *_ = np.linalg.lstsq(phi, values, rcond=None)
    left = values - phi @ found
    freedom = max(t.size - phi.shape[1], 1)
    variance = max(float(left @ left) / freedom, step**2 / 12.0) * max(inflation(left), 1.0)
    spread = np.sqrt(np.diag(np.linalg.pinv(phi.T @ phi)) * variance)
    n = k.size
    return found[:n] + 1j * found[n : 2 * n], np.sqrt((spread[:n] ** 2 + spread[n : 2 * n] ** 2) / 2.0)


def _driving(recording: Recording, start_s: float, end_s: float, w: float, k: np.ndarray) -> np.ndarray:
    """Return the complex amplitudes of the output, whole cycles, exactly."""
    inside = (recording.acts_s > start_s) & (recording.acts_s < end_s)
    at = np.concatenate(([start_s], recording.acts_s[inside], [end_s])) - start_s
    first = recording.output[np.searchsorted(recording.acts_s, start_s, side="right") - 1]
    levels = np.concatenate(([first], recording.output[inside]))
    turns = np.exp(-1j * np.outer(k * w, at))
    result: np.ndarray = 2j * (np.diff(turns, axis=1) @ levels) / (k * w * (end_s - start_s))
    return result
