"""Whether a model of a closed loop is the inverse of its controller instead of the process.

    u_k = u_{k-1} + a e_k + b e_{k-1} + c e_{k-2},   e = sp - pv          the controller, by least squares
    C(z) = (a + b z^-1 + c z^-2) / (1 - z^-1)
    d = sum_w |1 + G C|^2 S_u / sum_w (1 + |G C|)^2 S_u                   0 where G = -1/C

`S_u` power of the output. Where no set point is recorded, it is taken to be constant, so that `e = -pv`. Every closed
loop without a move of the set point offers `G = -1/C` to a fit, with the smallest residual of all: the output repeats
the noise of the PV. (Ljung, System Identification, 1999, ch. 13.4.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.process import frequency_response
from autotuner.core.signals.feedback import moves_all_the_time

if TYPE_CHECKING:
    from autotuner.core.model.arrays import ComplexArray, FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

FEWEST = 30
"""Samples from which a controller can be determined."""
SURE = 0.9
"""Share of the output's moves that a controller of this form explains where it is the one."""
ALIKE = 0.15
"""`sqrt(d)` up to which a model is the controller's inverse; a stable loop with integral action is well above."""
FREQUENCIES = 40
"""Frequencies, those with the most power, at which output and PV are compared."""


@dataclass(frozen=True, slots=True, eq=False)
class Controller:
    """The controller that a recording shows: coefficients of `e`, the sample interval in s, and power of the output."""

    coefficients: FloatArray
    interval_s: float
    frequencies: FloatArray
    power: FloatArray

    @property
    def sign_of_process(self) -> int:
        """The sign of the gain of a process that it controls: that of its integral action; 0 for none of that sign.

        With the other one, the loop would run away from its set point.
        """
        moves_at_once, integrates = np.sign(self.coefficients[0]), np.sign(self.coefficients.sum())
        return int(integrates) if moves_at_once == integrates else 0

    def response(self) -> ComplexArray:
        """Return `C` at the frequencies, output/PV."""
        back = np.exp(-1j * self.frequencies * self.interval_s)
        a, b, c = self.coefficients
        result: ComplexArray = (a + b * back + c * back**2) / (1.0 - back)
        return result


def controller_of(recording: Recording) -> Controller | None:
    """Return the controller that moved the output; None where none of this form did."""
    u, pv = recording.output, recording.pv
    if u.size < FEWEST or not moves_all_the_time(recording):
        return None
    sp = recording.set_point
    known = sp is not None and bool(np.isfinite(sp).all())
    e = (sp if known and sp is not None else 0.0) - pv
    moves, columns = np.diff(u)[1:], np.column_stack([e[2:], e[1:-1], e[:-2]])
    columns = columns if known else np.column_stack([columns, np.ones(moves.size)])
    inside = (u[2:] > u.min()) & (u[2:] < u.max())
    power = float(moves[inside] @ moves[inside])
    if np.count_nonzero(inside) < FEWEST or power <= 0.0:
        return None
    scale = np.maximum(np.abs(columns[inside]).max(axis=0), SMALLEST_DIVISOR)
    found = np.linalg.lstsq(columns[inside] / scale, moves[inside], rcond=None)[0]
    left = moves[inside] - columns[inside] / scale @ found
    if float(left @ left) > (1.0 - SURE) * power:
        return None
    interval = recording.duration_s / (u.size - 1)
    spectrum = np.abs(np.fft.rfft((u - u.mean()) * np.hanning(u.size)))[1:] ** 2
    w = np.linspace(1.0, spectrum.size, spectrum.size, dtype=np.float64) * (2.0 * math.pi / (u.size * interval))
    strongest = np.argsort(spectrum)[-FREQUENCIES:]
    return Controller(found[:3] / scale[:3], interval, w[strongest], spectrum[strongest])


def is_inverse(model: ProcessModel, controller: Controller | None, zero_s: float = 0.0) -> bool:
    """Return whether a model, times `1 - zero_s s`, is the inverse of the controller in the record."""
    if controller is None:
        return False
    beside = 1.0 - 1j * zero_s * controller.frequencies
    loop = frequency_response(model, controller.frequencies) * beside * controller.response()
    near = float(np.sum(np.abs(1.0 + loop) ** 2 * controller.power))
    return near < ALIKE**2 * float(np.sum((1.0 + np.abs(loop)) ** 2 * controller.power))
