"""Running model during the relay phase: computed after each half period, outside of the control loop.

The learned correction answers first; least squares answers after it, and starts from its own model of the half period
before, at first from the learned one. A static gain that the oscillation does not show comes from there too.

Invariants: the control loop never waits for it; while one estimate is computed no other is begun, the latest
record is taken next; it only informs, the experiment decides.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

from autotuner.application.computing.computations import learned_so_far, running_model
from autotuner.control.reporting.events import EstimateUpdated, ModelUpdated
from autotuner.core.model.process import Integrating, UnstableFopdt, sum_of_lags

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from autotuner.control.compute_port import ComputePool
    from autotuner.control.driving.controller_port import Conductor
    from autotuner.control.reporting.events import Event
    from autotuner.core.identification import RunningModel
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

FEWEST_HALF_PERIODS = 2
"""Half periods, three switches, before a model is tried."""


class Estimated(Protocol):
    """A tuning, as far as it is estimated while it runs."""

    @property
    def controller(self) -> Conductor | None:
        """Controller of the experiment."""

    def follow(self, *, samples: bool = True) -> AsyncIterator[Event]:
        """Yield its events."""

    def recording(self) -> Recording:
        """Return the recording so far."""

    def publish(self, event: Event) -> None:
        """Take an event."""


async def estimate_while_running(tuning: Estimated, pool: ComputePool) -> None:
    """Follow a tuning to its end; after each half period make models, and pass the experiment their uncertainty."""
    fitted_until_s, known = 0.0, None
    async for event in tuning.follow(samples=False):
        outdated = event.t < fitted_until_s
        if isinstance(event, EstimateUpdated) and event.half_period >= FEWEST_HALF_PERIODS and not outdated:
            fitted_until_s, known = await _estimate(tuning, pool, known)


async def _estimate(
    tuning: Estimated, pool: ComputePool, known: RunningModel | None
) -> tuple[float, RunningModel | None]:
    """Compute models of the record so far; return the time of the last one, and the latest that explains it."""
    recording = await pool.aside(tuning.recording)
    until_s, measured = float(recording.t[-1]), recording.settings.get("noise_sigma")
    noise = measured if isinstance(measured, float) else 0.0
    gain = None if known is None else (known.model.K, known.standard_error["K"])
    learned = await pool.run(learned_so_far, recording, noise, gain)
    _inform(tuning, until_s, learned)
    begun = known or learned
    running = await pool.run(running_model, recording, noise, None if begun is None else begun.model)
    if running is not None and not running.explains:
        _inform_of_kind(tuning, until_s, running.model)
        return until_s, known
    _inform(tuning, until_s, running)
    return until_s, running or known


def _inform_of_kind(tuning: Estimated, until_s: float, model: ProcessModel) -> None:
    """Pass only that the process integrates: a PV that has to be brought back does not wait for a good model."""
    if tuning.controller is not None and tuning.controller.experiment is not None:
        tuning.controller.experiment.inform(math.inf, integrating=as_integrator(model, until_s))


def as_integrator(model: ProcessModel, until_s: float) -> Integrating | None:
    """Return a process as an integrator where its PV has no equilibrium within about the duration of the test.

    A record cannot distinguish an integrator from a lag longer than itself, and quick fits confuse the two.
    """
    if isinstance(model, Integrating | UnstableFopdt):
        return model if isinstance(model, Integrating) else None
    if sum_of_lags(model) <= until_s:
        return None
    _, first, *further = model.rational().a
    return Integrating(model.K / first, further[0] / first if further else 0.0, model.D)


def _inform(tuning: Estimated, until_s: float, running: RunningModel | None) -> None:
    """Publish a model; use it for the end of the relay phase where it explains the record."""
    if running is None or tuning.controller is None or tuning.controller.experiment is None:
        return
    if running.explains:
        tuning.controller.experiment.inform(
            running.relative_error, running.expected_loss, integrating=as_integrator(running.model, until_s)
        )
    model = running.model
    values, errors = model.parameters(), dict(running.standard_error)
    gains = None if running.gains is None else dict(running.gains)
    tuning.publish(
        ModelUpdated(until_s, model.structure, values, errors, running.relative_error, running.method, gains)
    )
