"""A structure that was asked for, beside the one that the recording shows.

What is asked for may be simpler than the process on purpose, and is then given with a word about what is lost. But an
integrator fitted to a step that settles answers with a gain of the wrong sign, and a controller for it would run away:
that is refused, with what the recording shows instead.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.identification.selection import EXACT, choose
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
    """Return a refusal where the gain of a structure asked for has the wrong sign, and else what has to be said of it.

    Parameters
    ----------
    structure : str
        What was asked for, or ``auto``.
    asked : Choice
        The fit of it. Where it leaves noise alone, nothing else is fitted.
    data : Data
        The recording.
    prior : GainPrior
        What is known of the static gain.
    step : float
        Smallest step of the PV.
    """
    best = asked.best
    shown = None if structure == "auto" or best.white else _shown(best, data, prior, step)
    if shown is None:
        return None, ()
    return (None, (_warning(best, shown),)) if best.model.K * shown.model.K > 0.0 else (_refusal(best, shown), ())


def _shown(asked: Candidate, data: Data, prior: GainPrior, step: float) -> Candidate | None:
    """Return what the recording shows where that explains far more; None where it does not."""
    auto = choose(data, "auto", prior, step, EXACT)
    if auto is None or auto.best.rmse > FAR_BETTER * asked.rmse or auto.best.worth() < 0.0:
        return None
    return auto.best


def _refusal(asked: Candidate, shown: Candidate) -> Verdict:
    return refused(
        "structure_does_not_fit",
        f"as {asked.model.structure} the recording gives K {asked.model.K:.4g}, of the wrong sign: what it shows is "
        f"{_told(shown)}, with a residual of {shown.rmse:.3g} instead of {asked.rmse:.3g}",
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
