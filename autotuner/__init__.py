"""relay-autotuner: tune a real control loop with a relay and prove the model on measured data.

    import autotuner

    recording = autotuner.Recording.from_csv("relay.csv")
    identification = autotuner.identify(recording)
    tuning = autotuner.tune(identification.model, goal="balanced")

The names below are loaded when they are first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from autotuner.core.diagnosis import Diagnosis, diagnose
    from autotuner.core.identification import Estimate, Identification, LimitCycle, identify
    from autotuner.core.process import (
        Fopdt,
        Integrating,
        InverseResponse,
        InverseResponseUnderdamped,
        ProcessModel,
        SopdtOverdamped,
        SopdtUnderdamped,
        UnstableFopdt,
    )
    from autotuner.core.recording import Recording
    from autotuner.core.tuning import PidGains, Tuning, tune
    from autotuner.core.verdict import Verdict
    from autotuner.errors import AutotunerError

__all__ = [
    "AutotunerError",
    "Diagnosis",
    "Estimate",
    "Fopdt",
    "Identification",
    "Integrating",
    "InverseResponse",
    "InverseResponseUnderdamped",
    "LimitCycle",
    "PidGains",
    "ProcessModel",
    "Recording",
    "SopdtOverdamped",
    "SopdtUnderdamped",
    "Tuning",
    "UnstableFopdt",
    "Verdict",
    "diagnose",
    "identify",
    "tune",
]

_HOMES = {
    "autotuner.core.diagnosis": ("Diagnosis", "diagnose"),
    "autotuner.core.identification": ("Estimate", "Identification", "LimitCycle", "identify"),
    "autotuner.core.process": (
        "Fopdt",
        "Integrating",
        "InverseResponse",
        "InverseResponseUnderdamped",
        "ProcessModel",
        "SopdtOverdamped",
        "SopdtUnderdamped",
        "UnstableFopdt",
    ),
    "autotuner.core.recording": ("Recording",),
    "autotuner.core.tuning": ("PidGains", "Tuning", "tune"),
    "autotuner.core.verdict": ("Verdict",),
    "autotuner.errors": ("AutotunerError",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    """Load a public name from its home."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
