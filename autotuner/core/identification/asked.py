"""A structure that was asked for, beside the one that the recording shows.

What is asked for may be simpler than the process on purpose, and is then given with a word about what is lost. But an
integrator fitted to a step that settles answers with a gain of the wrong sign, and a controller for it would run away;
or it answers with so long a dead time that only the settled PV is left to explain. Where the criterion tells it from
what the recording shows, such a fit is refused, with what that is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.identification.candidate import EVIDENCE
from autotuner.core.identification.selection import EXACT, NEAR_TIE, choose, ranked
from autotuner.core.verdict import Verdict, refused

if TYPE_CHECKING:
    from autotuner.core.identification.candidate import Candidate
    from autotuner.core.identification.data import Data, GainPrior
    from autotuner.core.identification.selection import Choice

FAR_BETTER = 0.5
"""Residual of what the recording shows, over that of what was asked for, at which the user has to be told."""


def beside_the_record(
    structure: str, asked: Choice, data: Data, prior: GainPrior, step: float
) -> tuple[Verdict | None, tuple[str, ...]]:
    """Return a refusal where a structure asked for has no gain, or one of the wrong sign; else what has to be said.

    Parameters
    ----------
    structure : str
        What was asked for, or ``auto``.
    asked : Choice
        The fit of it. Where it leaves noise alone of all samples, nothing else is fitted.
    data : Data
        The recording.
    prior : GainPrior
        What is known of the static gain.
    step : float
        Smallest step of the PV.
    """
    best = asked.best
    everything = best.white and bool(best.counts.all())
    shown = None if structure == "auto" or everything else _shown(data, prior, step)
    if shown is None:
        return None, ()
    if best.worth() < EVIDENCE or best.model.K * shown.model.K <= 0.0:
        return (_refusal(best, shown) if _outranks(shown, best) else None), ()
    return None, ((_warning(best, shown),) if shown.rmse <= FAR_BETTER * best.rmse else ())


def _shown(data: Data, prior: GainPrior, step: float) -> Candidate | None:
    """Return what the recording shows; None where it shows no answer to the output."""
    auto = choose(data, "auto", prior, step, EXACT)
    return None if auto is None or auto.best.worth() < EVIDENCE else auto.best


def _outranks(shown: Candidate, asked: Candidate) -> bool:
    """Return whether the criterion, which pays for samples left out, tells the two apart."""
    both = ranked([shown, asked])
    return both.best is shown and (len(both.ranking) == 1 or both.ranking[1][1] > NEAR_TIE)


def _refusal(asked: Candidate, shown: Candidate) -> Verdict:
    K, left_out = asked.model.K, int(asked.counts.size - asked.counts.sum())
    given = "shows no answer" if asked.worth() < EVIDENCE else f"gives K {K:.4g}, of the wrong sign"
    without = f" with {left_out} of {asked.counts.size} samples left out" if left_out else ""
    return refused(
        "structure_does_not_fit",
        f"as {asked.model.structure} the recording {given}: what it shows is {_told(shown)}, with a residual of "
        f"{shown.rmse:.3g} instead of {asked.rmse:.3g}{without}",
        f"Leave the structure to auto, or ask for {shown.model.structure}.",
    )


def _warning(asked: Candidate, shown: Candidate) -> str:
    return (
        f"the recording shows {_told(shown)}, with a residual of {shown.rmse:.3g}: {asked.model.structure}, which was "
        f"asked for, leaves {asked.rmse:.3g}"
    )


def _told(shown: Candidate) -> str:
    parameters = ", ".join(f"{name} {value:.4g}" for name, value in shown.model.parameters().items())
    return f"{shown.model.structure} ({parameters})"
