"""relay-autotuner: tune a real control loop with a relay and prove the model on measured data.

    import autotuner

    recording = autotuner.Recording.from_csv("relay.csv")
    identification = autotuner.identify(recording)
    design = autotuner.design(identification.model, goal="balanced")

`autotuner.run(read=..., write=..., output=40.0, sample_time_s=0.5, limits=(0, 100))` tunes a plant of the caller's own.

The names below are loaded when they are first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from autotuner.application.analysis.diagnosis import diagnose
    from autotuner.core.design import PidDesign, PidGains
    from autotuner.core.diagnosis import Diagnosis
    from autotuner.core.identification import Estimate, Identification, LimitCycle, identify
    from autotuner.core.model.process import (
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
    from autotuner.core.verdict import Verdict
    from autotuner.errors import AutotunerError
    from autotuner.python_api import TuningResult, design, run, tune

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
    "PidDesign",
    "PidGains",
    "ProcessModel",
    "Recording",
    "SopdtOverdamped",
    "SopdtUnderdamped",
    "TuningResult",
    "UnstableFopdt",
    "Verdict",
    "design",
    "diagnose",
    "identify",
    "run",
    "tune",
]

_HOMES = {
    "autotuner.application.analysis.diagnosis": ("diagnose",),
    "autotuner.core.diagnosis": ("Diagnosis",),
    "autotuner.core.identification": ("Estimate", "Identification", "LimitCycle", "identify"),
    "autotuner.core.model.process": (
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
    "autotuner.core.design": ("PidGains", "PidDesign"),
    "autotuner.core.verdict": ("Verdict",),
    "autotuner.errors": ("AutotunerError",),
    "autotuner.python_api": ("TuningResult", "design", "run", "tune"),
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
