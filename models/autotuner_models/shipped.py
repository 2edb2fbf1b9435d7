"""The provider of trained corrections that comes with the tuner: its own files, or those of `AUTOTUNER_LEARNED`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.application.analysis.learned import ARTEFACTS
from autotuner_models.learned.artefacts import SHIPPED, load

if TYPE_CHECKING:
    from autotuner.core.identification.learned.correction import LearnedModels


def provider() -> LearnedModels:
    """Return the trained corrections.

    Raises
    ------
    ConfigurationError
        A file is missing, tampered with, or of another format; names the command to train again.
    """
    folder = os.environ.get(ARTEFACTS)
    return load(Path(folder) if folder else SHIPPED)
