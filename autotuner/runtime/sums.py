"""The sums that a service asks its workers for; each imports what it needs where it runs.

Rule of this file: whoever asks for a sum imports this module, and none of what the sums stand on: the estimators,
the search for gains and the catalogue of effects are in the memory of the workers only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from autotuner.core.identification import Identification, RunningModel
    from autotuner.core.monitoring import Expected, Findings
    from autotuner.core.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner.core.tuning import Tuning as Gains
    from autotuner.core.tuning import Wish
    from autotuner.runtime.analysed import Analysis


def analyse(recording: Recording, structure: str, wish: Wish) -> Analysis:
    """Return what a tuning's record tells, see `autotuner.runtime.analysis.analyse`."""
    from autotuner.runtime import analysis  # noqa: PLC0415 - the rule of this file

    return analysis.analyse(recording, structure, wish)


def gains_for(identification: Identification, wish: Wish, sample_time_s: float) -> Gains:
    """Return gains for an identified process, see `autotuner.runtime.analysis.gains_for`."""
    from autotuner.runtime import analysis  # noqa: PLC0415

    return analysis.gains_for(identification, wish, sample_time_s)


def learned_so_far(recording: Recording, noise_sigma: float, gain: tuple[float, float] | None) -> RunningModel | None:
    """Return the learned model of a record that is still growing, see `autotuner.runtime.learned`."""
    from autotuner.runtime import learned  # noqa: PLC0415

    return learned.learned_so_far(recording, noise_sigma, gain)


def running_model(recording: Recording, noise_sigma: float, begun: ProcessModel | None) -> RunningModel | None:
    """Return a quick model of the record so far, see `autotuner.core.identification.running`."""
    from autotuner.core import identification  # noqa: PLC0415

    return identification.running_model(recording, noise_sigma, begun)


def findings(recording: Recording, expected: Expected) -> Findings:
    """Return what a window of normal running shows, see `autotuner.core.monitoring`."""
    from autotuner.core import monitoring  # noqa: PLC0415

    return monitoring.findings(recording, expected)
