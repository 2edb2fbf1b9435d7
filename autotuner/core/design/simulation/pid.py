"""Discrete PID controller with anti-windup: for predictions, verification, and in parallel with a relay.

    u = Kp (b r - yf) + I - Kp Td dyf/dt,   I' = Kp (r - yf)/Ti + (u - v)/Tt

`v` is the output before limits and slew. The last term is the anti-windup: it unwinds the integral while the output is
limited (back calculation; Astrom and Hagglund, Advanced PID Control, 2006, section 3.5, with `Tt = sqrt(Ti Td)`, or
`Ti` for PI).

The measurement is filtered by `1/(1 + s Tf + s^2 Tf^2/2)`. Between two samples the PV is taken as straight, for which
the filter has a closed form: with `a = h/Tf`, the difference from the ramp response `(PV - Tf m, m)`, `m` the slope,
moves by

    e^{-a} [[cos a + sin a, Tf sin a], [-2 sin a/Tf, cos a - sin a]]

A device may filter its derivative alone, by the first order `1/(1 + s Td/N)`.

Invariants: settings and state are frozen; a step is a pure function of state and sample; the first sample
after `started` gives the output it was started with (bumpless transfer), whatever the gains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.design.gains import PidGains


@dataclass(frozen=True, slots=True)
class PidSettings:
    """Gains with the limits of the output.

    Attributes
    ----------
    gains : PidGains
        The controller.
    low, high : float
        Limits of the output, output units.
    slew_per_s : float
        Largest change of the output, output units/s.

    Raises
    ------
    InputError
        `low` not under `high`, or `slew_per_s` not positive.
    """

    gains: PidGains
    low: float = -math.inf
    high: float = math.inf
    slew_per_s: float = math.inf

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise InputError("must be under high", field="pid.low", value=self.low, remedy="Give the output limits.")
        if not self.slew_per_s > 0.0:
            raise InputError(
                "must be positive", field="pid.slew_per_s", value=self.slew_per_s, remedy="Leave it out for none."
            )

    @property
    def tracking_time(self) -> float:
        """Time constant of the anti-windup, s; infinite without integral action."""
        return math.sqrt(self.gains.Ti) * math.sqrt(self.gains.Td) if self.gains.Td > 0.0 else self.gains.Ti


class PidState(NamedTuple):
    """State of a controller between two samples.

    Attributes
    ----------
    t : float
        Time of the sample, s.
    pv, set_point : float
        Values of the sample.
    filtered, slope : float
        Filtered PV and its derivative.
    integral : float
        Integral part, output units; the bias of a controller without integral action.
    output : float
        Output commanded.
    damped : float
        The derivative as it acts, after its own filter.
    """

    t: float
    pv: float
    set_point: float
    filtered: float
    slope: float
    integral: float
    output: float
    damped: float = 0.0


def started(settings: PidSettings, t: float, pv: float, set_point: float, output: float) -> PidState:
    """Return the state of a controller that takes over at rest, with the present output."""
    return PidState(t, pv, set_point, pv, 0.0, output - settings.gains.Kp * (settings.gains.b * set_point - pv), output)


def step(settings: PidSettings, state: PidState, t: float, pv: float, set_point: float) -> PidState:
    """Return the state after a sample; `output` is the command.

    Parameters
    ----------
    settings : PidSettings
        Gains and limits.
    state : PidState
        State after the sample before.
    t : float
        Time of the sample, s, after that of the sample before.
    pv, set_point : float
        Process variable and set point, PV units.
    """
    return Interval.of(settings, t - state.t).after(state, t, pv, set_point)


@dataclass(frozen=True, slots=True)
class Interval:
    """A controller over one interval between samples: for many alike, its numbers are computed once.

    Attributes
    ----------
    settings : PidSettings
        Gains and limits.
    h : float
        Length of the interval, s.
    Kp, bKp, Kd, mean_Kih : float
        Gains of the filtered PV, the set point, the slope, and the sum of the errors at both ends.
    filtered, slope : (float, float)
        Rows of the matrix above, which moves the difference of filtered PV and slope from the ramp response.
    damping, unwinding : float
        Share of its way that the derivative's own filter goes, and of the excess that the anti-windup takes back.
    reach : float
        Largest change of the output, output units.
    """

    settings: PidSettings
    h: float
    Kp: float
    bKp: float
    Kd: float
    mean_Kih: float
    filtered: tuple[float, float]
    slope: tuple[float, float]
    damping: float
    unwinding: float
    reach: float

    @classmethod
    def of(cls, settings: PidSettings, h: float) -> Interval:
        """Return the numbers of an interval of `h` seconds."""
        gains = settings.gains
        filter_s = gains.derivative_filter_s
        filtered, slope = _motion_of_filter(gains.Tf, h)
        return cls(
            settings,
            h,
            gains.Kp,
            gains.Kp * gains.b,
            gains.Kd,
            gains.Ki * h / 2.0,
            filtered,
            slope,
            damping=1.0 - math.exp(-h / filter_s) if filter_s > 0.0 else 1.0,
            unwinding=min(1.0, h / settings.tracking_time) if gains.Ki else 0.0,
            reach=settings.slew_per_s * h,
        )

    def after(self, state: PidState, t: float, pv: float, set_point: float) -> PidState:
        """Return the state after a sample, see `step`."""
        m = (pv - state.pv) / self.h
        lag = self.settings.gains.Tf * m
        x, y = state.filtered - state.pv + lag, state.slope - m
        filtered = pv - lag + self.filtered[0] * x + self.filtered[1] * y
        slope = m + self.slope[0] * x + self.slope[1] * y
        integral = state.integral + self.mean_Kih * (state.set_point - state.filtered + state.set_point - filtered)
        damped = state.damped + self.damping * (slope - state.damped)
        wanted = self.bKp * set_point - self.Kp * filtered + integral - self.Kd * damped
        low, high = state.output - self.reach, state.output + self.reach
        output = min(max(wanted, low, self.settings.low), high, self.settings.high)
        integral += self.unwinding * (output - wanted)
        return PidState(t, pv, set_point, filtered, slope, integral, output, damped)


def _motion_of_filter(Tf: float, h: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the rows of the matrix by which the filter moves over an interval in which the PV is straight."""
    a = h / Tf if Tf > 0.0 else math.inf
    decay = math.exp(-a)
    if decay == 0.0:
        return (0.0, 0.0), (0.0, 0.0)
    c, s = decay * math.cos(a), decay * math.sin(a)
    return (c + s, Tf * s), (-2.0 * s / Tf, c - s)
