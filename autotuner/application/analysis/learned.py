"""Trained corrections, found by entry point: no name is built in, and none is required.

A package announces a provider under `autotuner.learned`: a callable that returns `LearnedModels` or raises an
`AutotunerError` that names the fault in its files. Everything is loaded on first use, and only once.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.control.devices.plugins import announced
from autotuner.core.identification import RunningModel, running_learned
from autotuner.core.identification.learned.correction import NOT_LOADED, LearnedModels
from autotuner.errors import AutotunerError, ConfigurationError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from autotuner.core.recording import Recording

LEARNED = "autotuner.learned"
ARTEFACTS = "AUTOTUNER_LEARNED"
"""Environment variable that names the folder of the trained corrections, for providers in this and other processes."""


def use_artefacts(folder: str) -> None:
    """Make this process, and those that it starts, use the trained corrections of a folder.

    Raises
    ------
    ConfigurationError
        The folder's files are missing, changed since their manifest was written, or made by other library versions.
    """
    os.environ[ARTEFACTS] = str(Path(folder).resolve())
    learned_models.cache_clear()
    found = learned_models()
    if isinstance(found, str):
        raise ConfigurationError(
            found, field="learned.artefacts", value=folder, remedy="Give a folder that `autotuner train --out` wrote."
        )


@cache
def learned_models() -> LearnedModels | str:
    """Return the models of the first usable provider, or a sentence on why there is none."""
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
