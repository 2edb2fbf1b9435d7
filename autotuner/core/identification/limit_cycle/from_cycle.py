"""Estimators from a limit cycle, as alternatives to least squares.

Both need a static gain, and the describing function needs a dead time for a second-order process; an oscillation shows
neither. The gain is the one given, else the one from the asymmetry of the relay, else that of least squares; the dead
time is that of least squares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.identification.limit_cycle import describing_function, inverse_cycle
from autotuner.core.identification.result import Estimate, refuse
from autotuner.core.signals.static_gain import gain_from_cycles
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.identification.limit_cycle.online_relay import Beside
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner.core.signals.limit_cycle import LimitCycle

DESCRIBING_FUNCTION = "describing_function"
CLOSED_FORM = "closed_form"
DF_STRUCTURES = ("fopdt", "sopdt_overdamped", "sopdt_underdamped")
EXACT: dict[str, Callable[[float, LimitCycle], ProcessModel]] = {
    "fopdt": inverse_cycle.fopdt_of_response,
    "sopdt_overdamped": inverse_cycle.sopdt_of_cycle,
    "sopdt_underdamped": inverse_cycle.sopdt_of_cycle,
    "integrating": lambda K, cycle: inverse_cycle.integrating_of_cycle(cycle, K),
    "unstable_fopdt": inverse_cycle.unstable_of_cycle,
}
"""Processes from a limit cycle without describing-function bias, by structure; an integrator needs the gain's sign."""
WIDEST = 0.999
"""Widest dead zone used, as a share of the amplitude: a switch at the very peak has no describing function."""


@dataclass(frozen=True, slots=True)
class Known:
    """A static gain and where it is from."""

    K: float
    source: str


def static_gain(
    recording: Recording, cycle: LimitCycle | None, known_gain: float | None, fitted: ProcessModel | None
) -> Known | None:
    """Return the static gain that the estimators of this file use."""
    if known_gain is not None:
        return Known(known_gain, "given")
    settles = fitted is None or fitted.rational().a[0] > 0.0
    measured = None if cycle is None or not settles else gain_from_cycles(recording, cycle)
    if measured is not None and measured.standard_error < abs(measured.K):
        return Known(measured.K, "asymmetric relay")
    return None if fitted is None else Known(fitted.K, "least squares")


def by_describing_function(
    cycle: LimitCycle | None,
    gain: Known | None,
    fitted: ProcessModel | None,
    structure: str,
    amplitude: str = "fundamental",
    beside: Beside | None = None,
) -> Estimate:
    """Return the describing function's estimate.

    Parameters
    ----------
    cycle : LimitCycle or None
        The oscillation.
    gain : Known or None
        The static gain.
    fitted : ProcessModel or None
        Where the dead time of a second-order process is from.
    structure : str
        Structure wanted.
    amplitude : str
        ``fundamental``, which the band-pass gives and with which `|G(jw)| = 1/N` holds, or ``peak``, as the thesis has
        it for the first-order process.
    beside : Beside, optional
        The controller in parallel with the relay.
    """
    if refusal := _lacking(cycle, gain, structure, DF_STRUCTURES) or _not_as_declared(beside):
        return refuse(DESCRIBING_FUNCTION, refusal)
    assert cycle is not None  # noqa: S101 - lacking nothing
    assert gain is not None  # noqa: S101
    first_order = structure == "fopdt"
    A = cycle.A if amplitude == "peak" else cycle.A1
    h = math.pi / 4.0 * cycle.relay_fundamental
    eps = min(cycle.hysteresis, WIDEST * A)
    D = None if first_order or fitted is None else fitted.D
    evidence = {"K_from": gain.source, "amplitude": amplitude, "h": h, "A": A, "Pu": cycle.Pu, "eps": eps, "D": D}
    if beside is not None:
        evidence |= {"controller": beside.declared, "controller_seen": beside.seen}
    try:
        model = _by_formula(gain.K, D, (h, A, cycle.Pu, eps), beside)
    except InputError as error:
        return refuse(DESCRIBING_FUNCTION, f"{error.field} {error.message}", evidence)
    return Estimate(DESCRIBING_FUNCTION, model, evidence=evidence)


def _by_formula(
    K: float, D: float | None, wave: tuple[float, float, float, float], beside: Beside | None
) -> ProcessModel:
    """Return the model of first order, or with a dead time of second; `wave` is `h`, `A`, `Pu`, `eps`."""
    Gc = 0.0 if beside is None else beside.declared
    of = describing_function
    return of.fopdt(K, *wave, Gc) if D is None else of.sopdt(K, D, *wave, Gc)


def by_closed_form(
    cycle: LimitCycle | None, gain: Known | None, structure: str, beside: Beside | None = None
) -> Estimate:
    """Return the estimate from the exact equations of the cycle; none for a relay with a parallel controller."""
    if beside is not None:
        return refuse(CLOSED_FORM, "a controller ran beside the relay, and the closed form is that of the relay alone")
    if refusal := _lacking(cycle, gain, structure, tuple(EXACT)):
        return refuse(CLOSED_FORM, refusal)
    assert cycle is not None  # noqa: S101 - lacking nothing
    assert gain is not None  # noqa: S101
    evidence = {"K_from": gain.source, "A": cycle.A, "high_s": cycle.high_s, "low_s": cycle.low_s}
    try:
        return Estimate(CLOSED_FORM, EXACT[structure](gain.K, cycle), evidence=evidence)
    except InputError as error:
        return refuse(CLOSED_FORM, f"{error.field} {error.message}", evidence)


def _lacking(cycle: LimitCycle | None, gain: Known | None, structure: str, structures: tuple[str, ...]) -> str | None:
    """Return the missing input of a method, or None."""
    if cycle is None:
        return "the recording holds no steady oscillation under a relay"
    if gain is None:
        return "the static gain is not known: give it, or use an asymmetric relay"
    return None if structure in structures else f"has no formula for the structure {structure}"


def _not_as_declared(beside: Beside | None) -> str | None:
    """Return the fault of the parallel controller, or None."""
    if beside is None or beside.as_declared:
        return None
    return (
        f"the parallel controller responded with {beside.seen:.3g} at this period, not with the "
        f"{beside.declared:.3g} of its gains: a limit or the slew of the output held it back"
    )
