"""Trained corrections, found by entry point: the tuner knows none by name, and works without any.

A package announces a provider under `autotuner.learned`: a callable that returns `LearnedModels` or raises an
`AutotunerError` that says what is wrong with its files. Nothing is loaded before it is asked for, and only once.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from autotuner.core.identification import RunningModel, running_learned
from autotuner.core.identification.learned import NOT_LOADED, LearnedModels
from autotuner.errors import AutotunerError
from autotuner.runtime.plugins import announced

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from autotuner.core.recording import Recording

LEARNED = "autotuner.learned"


@cache
def learned_models() -> LearnedModels | str:
    """Return what the first provider that can be used provides, or a sentence on why there is none."""
    reasons = []
    for point in announced(LEARNED).values():
        found = _provided(point)
        if isinstance(found, LearnedModels):
            return found
        reasons.append(found)
    return "; ".join(reasons) or NOT_LOADED


def learned_so_far(recording: Recording, noise_sigma: float, gain: tuple[float, float] | None) -> RunningModel | None:
    """Return the learned model of a record that is still growing, see `running_learned`; None without trained files."""
    models = learned_models()
    return running_learned(recording, noise_sigma, models, gain) if isinstance(models, LearnedModels) else None


def _provided(point: EntryPoint) -> LearnedModels | str:
    try:
        provided = point.load()()
    except AutotunerError as error:
        return str(error)
    except ImportError as error:
        return f"the learned correction {point.name} cannot be loaded: {error}"
    return provided if isinstance(provided, LearnedModels) else f"{point.name} does not provide trained corrections"
