"""Our own: output-error least squares on the exact response to the recorded output (`identification.least_squares`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.estimation.data import data_of
from autotuner.core.identification.selection import choose
from autotuner.errors import InputError
from autotuner_models.literature.trial import BIASED, FOPDT, SOPDT, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial


def estimate(trial: Trial) -> ProcessModel:
    """Return the best fit of the structure wanted; nothing is given to it."""
    choice = choose(data_of(trial.recording(BIASED)), trial.structure)
    if choice is None:
        raise InputError(f"fits no {trial.structure}", field="tests.biased", remedy="Ask for another structure.")
    return choice.best.model


METHOD = Method("least_squares", "Least squares (this program)", FOPDT + SOPDT, estimate, finds_all=True)
