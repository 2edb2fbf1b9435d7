"""Two loops that disturb each other: relative gain, margins of each with the other one closed, detuning, decoupling.

    y1 = G11 u1 + G12 u2,   y2 = G21 u1 + G22 u2,   u_i = -C_i y_i

    relative gain        lambda = 1/(1 - kappa),   kappa = G12 G21/(G11 G22)
    shared factor        f = 1 - kappa T1 T2,      T_i = C_i G_ii S_i,   S_i = 1/(1 + C_i G_ii)
    with both closed     S_i' = S_i/f,   T_i' = 1 - S_i'

`det(I + G C) = f/(S1 S2)`: two loops that are stable alone are stable together when `f` does not turn about the origin.
A relative gain at rest below 0 is such a turn under integral action, whatever the gains. Detuning slows both loops by
one factor, `Kp/F`, `F Ti`, `Td/F` (Luyben, Ind. Eng. Chem. Process Des. Dev. 25, 1986), the smallest with which both
keep the limits. A decoupler adds `d12 v2` to the first output and `d21 v1` to the second, with `d12 = -K12/K11` and
`d21 = -K21/K22`; the gains of the controllers are then divided by `1 - kappa(0)` (Bristol, IEEE Trans. AC-11, 1966, for
the relative gain; Seborg, Edgar and Mellichamp, Process Dynamics and Control, ch. 18, for both remedies).

Frequencies rad/s; `lambda`, `kappa`, `f`, `F` dimensionless; `d12` output of loop 1 per output of loop 2.

Invariants: responses carry the exact dead times; a pair whose loops are not stable alone is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.design.gains import controller_response
from autotuner.core.design.nyquist import frequency_grid
from autotuner.core.model.process import Integrating, UnstableFopdt, frequency_response
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.design.gains import PidGains
    from autotuner.core.model.arrays import ComplexArray, FloatArray
    from autotuner.core.model.process import ProcessModel

DETUNINGS = np.geomspace(1.0, 100.0, 400)
"""Factors that are tried, 1.2 % apart; a pair that needs a hundredfold slower loops is not controlled."""
WEAK = 0.1
"""Distance of the relative gain from 1 up to which two loops hardly meet."""
OTHER_PAIRING = 0.5
"""Relative gain below which the other pairing, with one minus this relative gain, interacts less."""
ROUNDING = 1.005
"""Excess over a limit that the frequency grid explains."""
MOST_DECOUPLED = 5.0
"""Relative gain from which a decoupler is refused: it inverts a nearly singular process, and its errors rule."""


@dataclass(frozen=True, slots=True)
class Pair:
    """Two loops as a process with two inputs and two outputs; None for a path that shows no answer.

    Attributes
    ----------
    first, second : ProcessModel
        `G11` and `G22`.
    on_first, on_second : ProcessModel or None
        `G12`, from the second output to the first PV, and `G21`.
    gains : tuple of PidGains
        The two controllers.
    """

    first: ProcessModel
    second: ProcessModel
    on_first: ProcessModel | None
    on_second: ProcessModel | None
    gains: tuple[PidGains, PidGains]


@dataclass(frozen=True, slots=True)
class LoopTogether:
    """A loop while the other one is closed: its sensitivities, and those that it has alone.

    Attributes
    ----------
    Ms_alone, Mt_alone : float
        With the other loop in manual.
    Ms, Mt : float or None
        With the other loop in automatic; None where the pair is not stable.
    """

    Ms_alone: float
    Mt_alone: float
    Ms: float | None
    Mt: float | None


@dataclass(frozen=True, slots=True)
class Interaction:
    """Interaction of two loops.

    Attributes
    ----------
    relative_gain : float or None
        `lambda` at rest; None where a process integrates, which has no rest.
    relative_gain_at_crossover : float
        `1/|1 - kappa|` at the frequency where the slower loop's sensitivity peaks.
    stable : bool
        Whether the pair is stable with both loops closed.
    loops : tuple of LoopTogether
        Each loop.
    """

    relative_gain: float | None
    relative_gain_at_crossover: float
    stable: bool
    loops: tuple[LoopTogether, LoopTogether]

    @property
    def worst(self) -> float:
        """The largest sensitivity of the pair; infinite where it is not stable."""
        return max((max(loop.Ms or math.inf, loop.Mt or math.inf) for loop in self.loops), default=math.inf)

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "relative_gain": self.relative_gain,
            "relative_gain_at_crossover": self.relative_gain_at_crossover,
            "stable": self.stable,
            "loops": [{name: getattr(one, name) for name in one.__slots__} for one in self.loops],
        }


@dataclass(frozen=True, slots=True)
class Remedy:
    """Other gains for the pair, and a decoupler where there is one.

    Attributes
    ----------
    gains : tuple of PidGains
        The two controllers.
    detuning : float
        `F`, by which both are slower than requested.
    decoupler : tuple of float or None
        `d12`, `d21`.
    interaction : Interaction
        The pair with these.
    """

    gains: tuple[PidGains, PidGains]
    detuning: float
    decoupler: tuple[float, float] | None
    interaction: Interaction

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "gains": [gains.to_dict() for gains in self.gains],
            "detuning": self.detuning,
            "decoupler": None if self.decoupler is None else list(self.decoupler),
            "interaction": self.interaction.to_dict(),
        }


def interaction(pair: Pair) -> Interaction:
    """Return the interaction of two loops; raise `InputError` where one is not stable alone."""
    w = _grid(pair)
    found = _judged(pair, pair.gains, _responses(pair, w), w)
    if found is None:
        raise InputError(
            "are not stable alone", field="gains", value=pair.gains, remedy="Give the gains of the loops' own tunings."
        )
    return replace(found, relative_gain=_relative_gain(pair))


def detuned(pair: Pair, limit: float) -> Remedy:
    """Return both controllers slowed by the smallest factor with which the pair keeps a limit of Ms and Mt.

    Raises
    ------
    InputError
        No factor keeps it: the relative gain at rest is negative, or the loops are not stable alone.
    """
    w = _grid(pair)
    return _slowed(pair, pair.gains, limit, _responses(pair, w), w, None)


def decoupled(pair: Pair, limit: float) -> Remedy:
    """Return a static decoupler with controllers for the decoupled pair, slowed where the limit needs it.

    Raises
    ------
    InputError
        A process integrates, or the relative gain at rest is negative or so large that a decoupler would rest on the
        errors of the model.
    """
    relative = _relative_gain(pair)
    if relative is None or not 0.0 < relative <= MOST_DECOUPLED:
        raise InputError(
            f"allows no decoupler: a relative gain between 0 and {MOST_DECOUPLED:g} at rest is needed",
            field="relative_gain",
            value=relative,
            remedy="Pair the loops the other way round when it is negative; else detune them.",
        )
    d12, d21 = -_gain(pair.on_first) / pair.first.K, -_gain(pair.on_second) / pair.second.K
    w = _grid(pair)
    mixed = np.einsum("ijw,jk->ikw", _responses(pair, w), np.array([[1.0, d12], [d21, 1.0]]))
    first, second = (replace(gains, Kp=gains.Kp * relative) for gains in pair.gains)
    return _slowed(pair, (first, second), limit, mixed, w, (d12, d21))


def advice(found: Interaction) -> str:
    """Return the interaction of two loops in words, with advice."""
    relative = found.relative_gain
    if relative is not None and relative <= 0.0:
        return "the pairing is wrong: the relative gain is negative; let each output control the other PV"
    if not found.stable:
        return "each loop is stable alone, both together are not: detune or decouple before both are in automatic"
    distance = abs(1.0 - (found.relative_gain_at_crossover if relative is None else relative))
    worse = found.worst > 1.05 * max(max(one.Ms_alone, one.Mt_alone) for one in found.loops)
    if distance <= WEAK and not worse:
        return "the loops hardly meet: tune and run them as if each were alone"
    if relative is not None and relative < OTHER_PAIRING:
        return "the relative gain is under 0.5: the other pairing would interact less"
    if not worse:
        return "the loops meet, but the margins of both bear it"
    return "the loops meet: with both in automatic the margins shrink; detune, or decouple"


def _gain(model: ProcessModel | None) -> float:
    return 0.0 if model is None else model.K


def _relative_gain(pair: Pair) -> float | None:
    """Return the relative gain at rest; None where a process integrates."""
    paths = (pair.first, pair.second, pair.on_first, pair.on_second)
    if any(isinstance(model, Integrating) for model in paths):
        return None
    kappa = _gain(pair.on_first) * _gain(pair.on_second) / (pair.first.K * pair.second.K)
    return math.inf if kappa == 1.0 else 1.0 / (1.0 - kappa)


def _grid(pair: Pair) -> FloatArray:
    """Return frequencies that resolve both loops, rad/s."""
    loops = zip((pair.first, pair.second), pair.gains, strict=True)
    return np.unique(np.concatenate([frequency_grid(model, gains) for model, gains in loops]))


def _responses(pair: Pair, w: FloatArray) -> ComplexArray:
    """Return `G(jw)`, shape (2, 2, N)."""
    rows = ((pair.first, pair.on_first), (pair.on_second, pair.second))
    zero = np.zeros(w.size, dtype=np.complex128)
    return np.array([[zero if model is None else frequency_response(model, w) for model in row] for row in rows])


def _controllers(gains: tuple[PidGains, PidGains], w: FloatArray) -> ComplexArray:
    return np.stack([controller_response(one, w) for one in gains])


def _judged(pair: Pair, gains: tuple[PidGains, PidGains], G: ComplexArray, w: FloatArray) -> Interaction | None:
    """Return the interaction of two loops; None where one is not stable alone.

    Parameters
    ----------
    pair : Pair
        The processes, for their poles.
    gains : tuple of PidGains
        The two controllers.
    G : array of complex, shape (2, 2, N)
        Responses of the process that they see, with a decoupler in front where there is one.
    w : array of float, shape (N,)
        Frequencies, rad/s.
    """
    C = np.stack([controller_response(one, w) for one in gains])
    returned = 1.0 + np.stack((G[0, 0], G[1, 1])) * C
    for model, one, f in zip((pair.first, pair.second), gains, returned, strict=True):
        integrators = isinstance(model, Integrating) + math.isfinite(one.Ti)
        if round(_half_turns(f) - isinstance(model, UnstableFopdt) - integrators / 2.0) != 0:
            return None
    S = 1.0 / returned
    f = 1.0 - G[0, 1] * G[1, 0] * C[0] * C[1] * S[0] * S[1]
    stable = round(_half_turns(f)) == 0
    closed = S / f
    loops = [
        LoopTogether(_peak(S[i]), _peak(1.0 - S[i]), _peak(closed[i]), _peak(1.0 - closed[i]))
        if stable
        else LoopTogether(_peak(S[i]), _peak(1.0 - S[i]), None, None)
        for i in (0, 1)
    ]
    slower = int(min(np.argmax(np.abs(S), axis=1)))
    kappa = G[0, 1, slower] * G[1, 0, slower] / (G[0, 0, slower] * G[1, 1, slower])
    return Interaction(None, float(1.0 / abs(1.0 - kappa)), stable, (loops[0], loops[1]))


def _peak(response: ComplexArray) -> float:
    return float(np.max(np.abs(response)))


def _half_turns(f: ComplexArray) -> float:
    """Return how often a response that ends at 1 turns about the origin, in half turns over positive frequencies."""
    path = np.concatenate((f, [1.0]))
    return float(np.sum(np.angle(path[1:] / path[:-1]))) / math.pi


def _slowed(
    pair: Pair,
    gains: tuple[PidGains, PidGains],
    limit: float,
    G: ComplexArray,
    w: FloatArray,
    decoupler: tuple[float, float] | None,
) -> Remedy:
    """Return the controllers slowed by the smallest factor with which the pair keeps the limit."""
    relative = _relative_gain(pair) if decoupler is None else 1.0
    for F in map(float, DETUNINGS):
        slower = (_slower(gains[0], F), _slower(gains[1], F))
        found = _judged(pair, slower, G, w)
        if found is not None and found.stable and found.worst <= ROUNDING * limit:
            return Remedy(slower, F, decoupler, replace(found, relative_gain=relative))
    raise InputError(
        f"lets no pair of slower controllers keep Ms and Mt under {limit:g}",
        field="relative_gain",
        value=relative,
        remedy="Pair the loops the other way round, decouple them, or allow a larger sensitivity.",
    )


def _slower(gains: PidGains, F: float) -> PidGains:
    return replace(gains, Kp=gains.Kp / F, Ti=gains.Ti * F, Td=gains.Td / F, Tf=gains.Tf / F)
