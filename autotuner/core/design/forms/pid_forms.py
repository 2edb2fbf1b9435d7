"""PID forms of real devices, converted at the border.

With `Kp`, `Ti`, `Td` of the ideal form (`autotuner.core.design.gains`):

    parallel   Kp,  Ki = Kp/Ti,  Kd = Kp Td
    series     Kc (1 + 1/(s Ti')) (1 + s Td'):  Kp = Kc (1 + Td'/Ti'),  Ti = Ti' + Td',  Td = Ti' Td'/(Ti' + Td')
               back, with x = sqrt(1 - 4 Td/Ti):  Kc = Kp (1 + x)/2,  Ti' = Ti (1 + x)/2,  Td' = 2 Td/(1 + x)
    gain of the device  = Kp (PV span / PV full) (output full / output span)
    proportional band   = 100 / gain of the device

(Astrom and Hagglund, Advanced PID Control, 2006, section 3.2.) The series form has real zeros, so it exists only for
`Ti >= 4 Td`.

Invariants:

1. A device is a row of data (`autotuner.core.design.forms.presets`); the conversion is the same for all.
2. A conversion there and back is the same controller. What a device cannot hold is an error, never an approximation.
3. Integral action that is off is written as the device writes it: `integral_off`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from autotuner.core.design.gains import Action, PidGains
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


class Structure(StrEnum):
    """Structure of the three parts."""

    IDEAL = "ideal"
    PARALLEL = "parallel"
    SERIES = "series"


class Gain(StrEnum):
    """Unit of the proportional part."""

    FACTOR = "factor"
    BAND = "band"


class Integral(StrEnum):
    """Unit of the integral part: a time, repeats per time, or the integral gain `Kp/Ti`."""

    TIME = "time"
    RATE = "rate"
    GAIN = "gain"


@dataclass(frozen=True, slots=True)
class ModeSwitch:
    """Change of a device from automatic to manual and back.

    Attributes
    ----------
    signal : str
        Parameter that shows or sets the mode, as the device names it.
    auto, manual : tuple of int
        Its values in automatic and in manual; the first is written. Empty where the device has no such mode.
    manual_output : str
        Parameter that sets the output in manual.
    note : str
        What the user must know of it; with the document, where it is another one than that of the form.
    """

    signal: str
    auto: tuple[int, ...] = ()
    manual: tuple[int, ...] = ()
    manual_output: str = ""
    note: str = ""


@dataclass(frozen=True, slots=True)
class Form:
    """Representation of the gains in a device.

    Attributes
    ----------
    name, title, source : str
        Name in configurations, name for people, and where the form is described.
    structure, gain, integral : Structure, Gain, Integral
        Meaning of the three numbers. In the parallel structure the derivative is the gain `Kp Td`, else a time.
    time_unit_s : float
        Unit of the times (and of the times in gains), s.
    pv_full, output_full : float or None
        What the full span of PV and output counts as inside the device; None: engineering or output units.
    integral_off : float
        The number that means no integral action.
    signed : bool
        True: the sign of the gain is the action. False: the gain is positive and the device has an action setting.
    labels : tuple of three str
        The device's own names of gain, integral and derivative.
    mode : ModeSwitch or None
        Change of the mode; None for a form that is not a device, or without a statement of the manufacturer.
    """

    name: str
    title: str
    source: str
    structure: Structure = Structure.IDEAL
    gain: Gain = Gain.FACTOR
    integral: Integral = Integral.TIME
    time_unit_s: float = 1.0
    pv_full: float | None = None
    output_full: float | None = None
    integral_off: float = 0.0
    signed: bool = False
    labels: tuple[str, str, str] = ("Kp", "Ti", "Td")
    mode: ModeSwitch | None = None


@dataclass(frozen=True, slots=True)
class Spans:
    """Full span of PV (engineering units) and output (output units) of the loop, for devices that normalise."""

    pv: float | None = None
    output: float | None = None


@dataclass(frozen=True, slots=True)
class DeviceGains:
    """Gains as a device states them.

    Attributes
    ----------
    gain, integral, derivative : float
        The three numbers in the device's own meaning and units.
    action : Action
        Setting of the device's action; for a signed form it follows from the gain.
    Tf : float
        Time constant of the measurement filter, s.
    b : float
        Set-point weight.
    """

    gain: float
    integral: float
    derivative: float
    action: Action = Action.REVERSE
    Tf: float = 0.0
    b: float = 1.0

    def labelled(self, form: Form) -> dict[str, float]:
        """Return the three numbers under the device's own names."""
        return dict(zip(form.labels, (self.gain, self.integral, self.derivative), strict=True))


def to_device(gains: PidGains, form: Form, spans: Spans | None = None) -> DeviceGains:
    """Return the gains as the device states them.

    Raises
    ------
    InputError
        The form normalises by a span that is not given, or cannot hold the gains (series with `Ti < 4 Td`).
    """
    K, Ti, Td = _TO_STRUCTURE[form.structure](gains.Kp, gains.Ti, gains.Td)
    factor = abs(K) * _normalisation(form, spans or Spans())
    derivative = Td / form.time_unit_s
    if _is_parallel(form):
        derivative *= factor
    return DeviceGains(
        gain=(1.0 if gains.Kp > 0.0 or not form.signed else -1.0) * _GAINS[form.gain](factor),
        integral=_sign(form, gains) * _integral(form, Ti / form.time_unit_s, factor),
        derivative=_sign(form, gains) * derivative,
        action=gains.action,
        Tf=gains.Tf,
        b=gains.b,
    )


def from_device(device: DeviceGains, form: Form, spans: Spans | None = None) -> PidGains:
    """Return the controller that a device's numbers stand for.

    Raises
    ------
    InputError
        The form normalises by a span that is not given, or the numbers are no controller.
    """
    _check(device, form)
    factor = _GAINS[form.gain](abs(device.gain))
    Ti = form.time_unit_s * _integral_time(form, abs(device.integral), factor)
    Td = form.time_unit_s * abs(device.derivative)
    if _is_parallel(form):
        Td /= factor
    direct = device.gain < 0.0 if form.signed else device.action is Action.DIRECT
    K = (-1.0 if direct else 1.0) * factor / _normalisation(form, spans or Spans())
    Kp, Ti, Td = _FROM_STRUCTURE[form.structure](K, Ti, Td)
    return PidGains(Kp, Ti, Td, device.Tf, device.b)


def rounded(device: DeviceGains, resolution: Mapping[str, float]) -> DeviceGains:
    """Return the gains as the device holds them when it rounds `gain`, `integral` and `derivative` to a step.

    Parameters
    ----------
    device : DeviceGains
        Gains as the device states them.
    resolution : mapping of str to float
        Smallest step of ``gain``, ``integral``, ``derivative``; a name left out is not rounded.

    Raises
    ------
    InputError
        Unknown name, step that is not positive, or a gain (or an integral) that is so small that it rounds to zero.
    """
    held = {name: getattr(device, name) for name in ("gain", "integral", "derivative")}
    for name, step in resolution.items():
        field = f"resolution.{name}"
        if name not in held:
            raise InputError("is not a gain", field=field, value=step, remedy=f"Use {', '.join(held)}.")
        if not 0.0 < step < math.inf:
            raise InputError("must be a positive number", field=field, value=step, remedy="Give the device's step.")
        exact, held[name] = held[name], round(held[name] / step) * step
        if exact != 0.0 and held[name] == 0.0 and name != "derivative":
            raise InputError(
                "is under half a step of the device and would become zero",
                field=f"gains.{name}",
                value=exact,
                remedy=f"Use a form with a finer step than {step:g}, or other time units.",
            )
    return DeviceGains(**held, action=device.action, Tf=device.Tf, b=device.b)


def _check(device: DeviceGains, form: Form) -> None:
    if not math.isfinite(device.gain) or device.gain == 0.0:
        raise InputError(
            "must be finite and not zero", field="gains.gain", value=device.gain, remedy="Read the gain again."
        )
    direct = form.signed and device.gain < 0.0
    signs = {"gain": direct, "integral": direct and _is_parallel(form), "derivative": direct and _is_parallel(form)}
    for name, negative in signs.items():
        value = getattr(device, name)
        if math.isnan(value) or (-value if negative else value) < 0.0:
            raise InputError(
                "must be a number of the right sign",
                field=f"gains.{name}",
                value=value,
                remedy="Gains share one sign, times are positive; an unsigned form has its own setting of the action.",
            )


def _is_parallel(form: Form) -> bool:
    return form.structure is Structure.PARALLEL


def _normalisation(form: Form, spans: Spans) -> float:
    """Return the factor from `Kp` to the device's gain."""
    pv = 1.0 if form.pv_full is None else _span(spans.pv, "pv", form) / form.pv_full
    output = 1.0 if form.output_full is None else form.output_full / _span(spans.output, "output", form)
    return pv * output


def _span(value: float | None, name: str, form: Form) -> float:
    if value is None or not 0.0 < value < math.inf:
        raise InputError(
            f"must be a positive span: {form.title} states its gain against it",
            field=f"spans.{name}",
            value=value,
            remedy=f"Give the full span of the {name} as configured in the device.",
        )
    return value


def _sign(form: Form, gains: PidGains) -> float:
    return -1.0 if form.signed and _is_parallel(form) and gains.Kp < 0.0 else 1.0


def _integral(form: Form, Ti: float, factor: float) -> float:
    return form.integral_off if math.isinf(Ti) else _INTEGRALS[form.integral](Ti, factor)


def _integral_time(form: Form, integral: float, factor: float) -> float:
    if integral in {form.integral_off, 0.0}:
        return math.inf
    return _INTEGRAL_TIMES[form.integral](integral, factor)


def _series_from_ideal(Kp: float, Ti: float, Td: float) -> tuple[float, float, float]:
    if Ti < 4.0 * Td:
        raise InputError(
            "the series form exists only for Ti >= 4 Td",
            field="gains.Td",
            value=Td,
            remedy=f"Choose a rule with Td of at most {Ti / 4.0:g} s for this Ti, or a PI controller.",
        )
    upper = (1.0 + math.sqrt(1.0 - 4.0 * Td / Ti)) / 2.0
    return Kp * upper, Ti * upper, Td / upper


def _ideal_from_series(Kc: float, Ti: float, Td: float) -> tuple[float, float, float]:
    interaction = 1.0 + Td / Ti
    return Kc * interaction, Ti + Td, Td / interaction


def _unchanged(Kp: float, Ti: float, Td: float) -> tuple[float, float, float]:
    return Kp, Ti, Td


_TO_STRUCTURE: dict[Structure, Callable[[float, float, float], tuple[float, float, float]]] = {
    Structure.IDEAL: _unchanged,
    Structure.PARALLEL: _unchanged,
    Structure.SERIES: _series_from_ideal,
}
_FROM_STRUCTURE: dict[Structure, Callable[[float, float, float], tuple[float, float, float]]] = {
    Structure.IDEAL: _unchanged,
    Structure.PARALLEL: _unchanged,
    Structure.SERIES: _ideal_from_series,
}
_GAINS: dict[Gain, Callable[[float], float]] = {
    Gain.FACTOR: lambda factor: factor,
    Gain.BAND: lambda factor: 100.0 / factor,
}
"""Each is its own inverse."""
_INTEGRALS: dict[Integral, Callable[[float, float], float]] = {
    Integral.TIME: lambda Ti, _: Ti,
    Integral.RATE: lambda Ti, _: 1.0 / Ti,
    Integral.GAIN: lambda Ti, factor: factor / Ti,
}
_INTEGRAL_TIMES: dict[Integral, Callable[[float, float], float]] = {
    Integral.TIME: lambda integral, _: integral,
    Integral.RATE: lambda integral, _: 1.0 / integral,
    Integral.GAIN: lambda integral, factor: factor / integral,
}
