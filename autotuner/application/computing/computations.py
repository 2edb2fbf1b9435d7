"""Computations of a service's workers; each imports its dependencies where it runs.

Invariant: a caller imports this module but none of the dependencies: estimators, the search for gains and the
catalogue of effects are in the memory of the workers only.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from autotuner.application.analysis.analysed import Analysis, Context
    from autotuner.core.design import DesignSpec, DeviceController, Installed, PidDesign
    from autotuner.core.identification import Identification, RunningModel
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.monitoring import Expected, Findings
    from autotuner.core.recording import Recording


def analyse(
    recording: Recording,
    structure: str,
    spec: DesignSpec,
    context: Context | None = None,
    budget_ms: float | None = None,
) -> Analysis:
    """Analyse a tuning's record, see `autotuner.application.analysis.procedure.analyse`.

    With a budget of processor time, see `autotuner.application.analysis.analysis_within_budget`.
    """
    from autotuner.application.analysis import procedure  # noqa: PLC0415 - the rule of this file

    context = context or procedure.UNKNOWN
    if budget_ms is None:
        return procedure.analyse(recording, structure, spec, context)
    from autotuner.application.analysis import analysis_within_budget  # noqa: PLC0415

    return analysis_within_budget.analyse_within(recording, structure, spec, context, budget_ms)


def gains_for(
    identification: Identification,
    spec: DesignSpec,
    sample_time_s: float,
    device: DeviceController | None = None,
    installed: Installed | None = None,
    output_span: float = math.inf,
) -> PidDesign:
    """Return gains for an identified process, see `autotuner.application.analysis.procedure.gains_for`."""
    from autotuner.application.analysis import procedure  # noqa: PLC0415

    return procedure.gains_for(
        identification, spec, sample_time_s, device=device, installed=installed, output_span=output_span
    )


def learned_so_far(recording: Recording, noise_sigma: float, gain: tuple[float, float] | None) -> RunningModel | None:
    """Return the learned model of a record that is still growing, see `autotuner.application.analysis.learned`."""
    from autotuner.application.analysis import early_gains, learned  # noqa: PLC0415 - only a worker needs it

    running = learned.learned_so_far(recording, noise_sigma, gain)
    return early_gains.with_gains(running, recording.sample_interval_s)


def running_model(recording: Recording, noise_sigma: float, initial: ProcessModel | None) -> RunningModel | None:
    """Return a quick model of the record so far, or the nearest one, see `core.identification.running_estimate`."""
    from autotuner.application.analysis import early_gains  # noqa: PLC0415
    from autotuner.core import identification  # noqa: PLC0415

    running = identification.running_model(recording, noise_sigma, initial, nearest=True)
    return early_gains.with_gains(running, recording.sample_interval_s)


def findings(recording: Recording, expected: Expected) -> Findings:
    """Compare a window of normal running with the expected behaviour, see `autotuner.core.monitoring`."""
    from autotuner.core import monitoring  # noqa: PLC0415

    return monitoring.findings(recording, expected)
