"""The running model beside the relay: after each half period, outside of the control loop.

Rules of this file: the control loop never waits for it; while one estimate is computed no other is begun, the latest
record is taken next; it only informs, the experiment decides.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.identification import running_model
from autotuner.runtime.events import EstimateUpdated, ModelUpdated

if TYPE_CHECKING:
    from autotuner.runtime.arithmetic import Arithmetic
    from autotuner.runtime.tuning import Tuning

FEWEST_HALF_PERIODS = 2
"""Half periods, three switches, before a model is tried."""


async def estimate_while_running(tuning: Tuning, arithmetic: Arithmetic) -> None:
    """Follow a tuning to its end; after each half period fit a model and tell the experiment how well it is known."""
    fitted_until_s = 0.0
    async for event in tuning.follow():
        outdated = event.t < fitted_until_s
        if isinstance(event, EstimateUpdated) and event.half_period >= FEWEST_HALF_PERIODS and not outdated:
            fitted_until_s = await _estimate(tuning, arithmetic)


async def _estimate(tuning: Tuning, arithmetic: Arithmetic) -> float:
    """Fit the record so far; return the time up to which it went."""
    recording = tuning.recording()
    noise = recording.settings.get("noise_sigma")
    running = await arithmetic.run(running_model, recording, noise if isinstance(noise, float) else 0.0)
    if running is not None and tuning.controller is not None and tuning.controller.experiment is not None:
        tuning.controller.experiment.inform(running.relative_error)
        model = running.model
        tuning.publish(
            ModelUpdated(
                float(recording.t[-1]),
                model.structure,
                model.parameters(),
                dict(running.standard_error),
                running.relative_error,
            )
        )
    return float(recording.t[-1])
