"""Structure selection by the extended Bayesian information criterion (BIC).

Structures are fitted by least squares, simple ones first, the others where these leave a residual to explain. The
extended Bayesian information criterion `n ln(S/N) + p (ln n + ln s)`, `s` structures tried, decides, with as many
independent samples `n` as the autocorrelation of the best residual leaves. Structures are nested (a second lag of zero
is none, an integrator is an infinite lag), so where two fit equally well the simpler one is chosen. (Schwarz, Ann.
Statist. 6, 1978; Chen and Chen, Biometrika 95, 2008.)

`beside_the_record` compares the structure that the caller requests with the selected one.

The requested structure may be simpler than the process on purpose, with a note on the difference. But an
integrator fitted to a step that settles has a gain of the wrong sign, and a controller for it would be unstable;
or it has so long a dead time that only the settled PV remains to be explained. Where the criterion separates
it from the selected structure, such a fit is refused, with the selected structure in the message.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.data import ANY_GAIN
from autotuner.core.estimation.initial_guesses import starts_from
from autotuner.core.estimation.least_squares import fit, freed
from autotuner.core.estimation.switch_times import may_be_unsure, promise
from autotuner.core.model.structures import (
    EQUAL_LAGS,
    FOPDT,
    INVERSE_RESPONSE,
    N_LAGS,
    SECOND_ORDER,
    THIRD_ORDER,
    searched,
)
from autotuner.core.verdict import Verdict, refused

if TYPE_CHECKING:
    from autotuner.core.estimation.candidate import Candidate
    from autotuner.core.estimation.data import Data, GainPrior
    from autotuner.core.model.structures import Structure

NEAR_TIE = 6.0
"""Difference of the criterion under which two structures are distinguished only weakly (Raftery 1995)."""

AUTO, EXACT, BETWEEN = "auto", "exact", "between"
MOMENTS = (AUTO, EXACT, BETWEEN)
"""When the output changed: at its samples or between them by the recording itself, at its samples, or between them."""
UNDECIDED = 15.0
"""Decrease of the log likelihood with free switch times up to which they are not excluded: shifts that change linearly
from switch to switch, as in a sampled steady oscillation, resemble a different gain."""

HIGHER_ORDER = (*N_LAGS, THIRD_ORDER)
"""Structures that are chosen only where they leave nothing but noise: their freedom bends to a saturated sensor or to a
disturbance as well, which a lower order shows as unexplained."""

NOTHING_LEFT = 3e-3
"""Residual over the swing of the PV up to which a higher order leaves nothing: without noise no residual is white,
neither that of a process of a still higher order nor what the search leaves."""
SMALLEST_GAIN = 4.0
"""Fall of `n ln S` that one more parameter has to promise before it is searched for."""


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """A structure chosen among candidates.

    Attributes
    ----------
    best : Candidate
        The chosen one.
    ranking : tuple of (Candidate, float)
        All of them with their criterion above the best one's, best first.
    between : Candidate or None
        The best one if the output changed between its samples, where the recording cannot rule that out.
    """

    best: Candidate
    ranking: tuple[tuple[Candidate, float], ...]
    between: Candidate | None = None

    @property
    def near_ties(self) -> tuple[Candidate, ...]:
        """The others that fit about as well, without being the chosen one with an idle parameter."""
        return tuple(other for other, above in self.ranking[1:] if above < NEAR_TIE and self._differs(other))

    def _differs(self, other: Candidate) -> bool:
        extra = other.parameters - self.best.parameters
        floor = self.best.floor**2
        gained = other.good.size * math.log((self.best.rmse**2 + floor) / (other.rmse**2 + floor))
        return extra <= 0 or gained > NEAR_TIE


def choose(
    data: Data, structure: str, prior: GainPrior = ANY_GAIN, resolution: float = 0.0, moments: str = AUTO
) -> Choice | None:
    """Return the structure that the recording shows, or the requested one.

    Parameters
    ----------
    data : Data
        The recording.
    structure : str
        A structure by name, or ``auto``.
    prior : GainPrior
        Prior knowledge of the static gain.
    resolution : float
        Smallest step of the PV.
    moments : str
        One of `MOMENTS`.

    Returns
    -------
    Choice or None
        None when no structure allowed has a physical fit.

    Raises
    ------
    InputError
        Unknown structure.
    """
    candidates: list[Candidate] = []
    for kind in searched(structure):
        if _ruled_out(kind, candidates, structure):
            continue
        candidate = _not_run_away(fit(data, kind, prior, resolution), candidates, data, prior, resolution)
        if candidate is not None and _is_requested(candidate, structure):
            candidates.append(candidate)
    if structure == "auto":
        candidates = [one for one in candidates if one.structure not in HIGHER_ORDER or _leaves_nothing(one)]
    return _moments_weighed(ranked(candidates), structure, prior, moments) if candidates else None


def _not_run_away(
    found: Candidate | None, others: list[Candidate], data: Data, prior: GainPrior, resolution: float
) -> Candidate | None:
    """Return a pair of lags beside measured disturbances from the fit of one lag, where its own search ran away.

    A second lag takes the place of dead time: a pair with more of it than one lag left its starts, at which the
    disturbances were placed for a preliminary process.
    """
    single = next((other for other in others if other.structure is FOPDT), None)
    if not data.others or found is None or found.structure is not SECOND_ORDER or single is None:
        return found
    if found.model.D <= single.model.D:
        return found
    again = fit(data, SECOND_ORDER, prior, resolution, starts_from(single.model, SECOND_ORDER))
    return found if again is None else ranked([found, again]).best


def _leaves_nothing(candidate: Candidate) -> bool:
    """Return whether a structure leaves nothing but noise."""
    return candidate.white or candidate.rmse <= NOTHING_LEFT * float(np.ptp(candidate.solution.problem.data.pv))


def _is_requested(candidate: Candidate, structure: str) -> bool:
    # Two nearly equal lags are fitted as a pair, which is of third order too.
    either = {candidate.structure.name} if candidate.structure is THIRD_ORDER else set()
    return structure in {"auto", candidate.model.structure, *either}


def _moments_weighed(choice: Choice, structure: str, prior: GainPrior, moments: str) -> Choice:
    """Return the choice with free times of the output's changes where the recording, or the user, requires it."""
    solution = choice.best.solution
    if moments == EXACT or not may_be_unsure(solution.problem.data):
        return choice
    if moments == AUTO and promise(solution) <= -UNDECIDED:
        return choice
    fixed = [candidate for candidate, _ in choice.ranking]
    free = [other for candidate in fixed if (other := freed(candidate, prior)) and _is_requested(other, structure)]
    if not free:
        return choice
    both = ranked([*fixed, *free])
    return ranked(free) if moments == BETWEEN or both.best in free else replace(choice, between=ranked(free).best)


def _ruled_out(kind: Structure, candidates: list[Candidate], structure: str) -> bool:
    """Return whether the fitted structures already leave no residual for this one to explain."""
    if not candidates or kind in {FOPDT, SECOND_ORDER}:
        return False
    if kind in N_LAGS and _enough_lags(candidates):
        return True
    if structure != "auto":
        # Two equal lags are the edge of the overdamped processes: fitted only when the best pair lies beyond it.
        return kind in EQUAL_LAGS
    best = ranked(candidates).best
    if kind in HIGHER_ORDER:
        # Of a higher order the one that is fitted first leaves little: the others are judged by the same lower order.
        best = ranked([candidate for candidate in candidates if candidate.structure not in HIGHER_ORDER]).best
    if kind in {INVERSE_RESPONSE, *HIGHER_ORDER}:
        return best.white and not best.answers_left and best.gain_of_curvature() < SMALLEST_GAIN
    return best.white and best.settles()


def _enough_lags(candidates: list[Candidate]) -> bool:
    """Return whether the last number of equal lags fitted worse than the one before: more of them fit worse still."""
    lags = [candidate for candidate in candidates if candidate.structure in N_LAGS]
    return len(lags) >= 2 and lags[-1].rmse > lags[-2].rmse


def ranked(candidates: list[Candidate]) -> Choice:
    """Return the candidates by their criterion; unresolved ones only when there are no others."""
    shown = [candidate for candidate in candidates if candidate.resolved] or candidates
    closest = min(shown, key=lambda candidate: candidate.rmse)
    independent = closest.good.size / closest.inflation
    shared = np.logical_and.reduce([candidate.counts for candidate in shown])
    values = sorted(((c, c.criterion(independent, shared)) for c in shown), key=lambda pair: pair[1])
    lowest = values[0][1]
    return Choice(values[0][0], tuple((candidate, value - lowest) for candidate, value in values))


FAR_BETTER = 0.5
"""Residual of the structure that the recording shows, over that of the requested one, at which the user is warned."""


def beside_the_record(
    structure: str, requested: Choice, data: Data, prior: GainPrior, step: float
) -> tuple[Verdict | None, tuple[str, ...]]:
    """Return a refusal where a requested structure has no gain, or one of the wrong sign; else the notes.

    Parameters
    ----------
    structure : str
        The requested structure, or ``auto``.
    requested : Choice
        Its fit. Where its residual is noise in all samples, nothing else is fitted.
    data : Data
        The recording.
    prior : GainPrior
        Prior knowledge of the static gain.
    step : float
        Smallest step of the PV.
    """
    best = requested.best
    everything = best.white and bool(best.counts.all())
    shown = None if structure == "auto" or everything else _shown(data, prior, step)
    if shown is None:
        return None, ()
    if not best.is_shown() or best.model.K * shown.model.K <= 0.0:
        return (_refusal(best, shown) if _outranks(shown, best) else None), ()
    return None, ((_warning(best, shown),) if shown.rmse <= FAR_BETTER * best.rmse else ())


def _shown(data: Data, prior: GainPrior, step: float) -> Candidate | None:
    """Return the best response in the recording; None without a response to the output."""
    auto = choose(data, "auto", prior, step, EXACT)
    return None if auto is None or not auto.best.is_shown() else auto.best


def _outranks(shown: Candidate, requested: Candidate) -> bool:
    """Return whether the criterion, which pays for samples left out, separates the two."""
    both = ranked([shown, requested])
    return both.best is shown and (len(both.ranking) == 1 or both.ranking[1][1] > NEAR_TIE)


def _refusal(requested: Candidate, shown: Candidate) -> Verdict:
    K, left_out = requested.model.K, int(requested.counts.size - requested.counts.sum())
    given = "shows no answer" if not requested.is_shown() else f"gives K {K:.4g}, of the wrong sign"
    without = f" with {left_out} of {requested.counts.size} samples left out" if left_out else ""
    return refused(
        "structure_does_not_fit",
        f"as {requested.model.structure} the recording {given}: what it shows is {_described(shown)}, with a residual "
        f"of {shown.rmse:.3g} instead of {requested.rmse:.3g}{without}",
        f"Leave the structure to auto, or ask for {shown.model.structure}.",
    )


def _warning(requested: Candidate, shown: Candidate) -> str:
    return (
        f"the recording shows {_described(shown)}, with a residual of {shown.rmse:.3g}: {requested.model.structure}, "
        f"which was requested, leaves {requested.rmse:.3g}"
    )


def _described(shown: Candidate) -> str:
    parameters = ", ".join(f"{name} {value:.4g}" for name, value in shown.model.parameters().items())
    return f"{shown.model.structure} ({parameters})"
