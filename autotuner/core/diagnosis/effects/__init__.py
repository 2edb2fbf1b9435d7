"""The catalogue of effects, by place."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.flow_delay import dead_time_jump, flow_delay
from autotuner.core.diagnosis.effects.actuator.friction import friction_effects
from autotuner.core.diagnosis.effects.actuator.levels import step_grids
from autotuner.core.diagnosis.effects.actuator.textbook_forms import actuator_effects
from autotuner.core.diagnosis.effects.actuator.time_proportioning import time_proportioning
from autotuner.core.diagnosis.effects.actuator.update_jitter import update_grids
from autotuner.core.diagnosis.effects.declared import declared_effects
from autotuner.core.diagnosis.effects.disturbance import disturbance_effects
from autotuner.core.diagnosis.effects.free_forms import free_forms
from autotuner.core.diagnosis.effects.jumps import jump_moments
from autotuner.core.diagnosis.effects.process.textbook_forms import further_lags, process_effects
from autotuner.core.diagnosis.effects.sensor_hysteresis import sensor_hysteresis
from autotuner.core.diagnosis.effects.waves import slow_wave
from autotuner.core.diagnosis.record.waiting import waiting_of
from autotuner.core.effect_plugins import installed_effects

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.model.arrays import IntArray
    from autotuner.core.model.process import ProcessModel


def catalogue(
    base: Fitted, rows: IntArray, declared: ProcessModel | None = None, others: Sequence[Fitted] = ()
) -> tuple[Effect, ...]:
    """Return the effects that a recording could show, with starts taken from it.

    A loop whose PV follows every move of the output has no friction in it, whatever fits. Where the PV waits and jumps,
    a wave of few periods is the cycle of a valve that sticks, and none of the surroundings.

    Parameters
    ----------
    base : Fitted
        The process model alone: its residual shows where to start.
    rows : array of int
        Samples to use.
    declared : ProcessModel, optional
        The declared model; physics that a free model would absorb is then an effect too.
    others : sequence of Fitted
        Further process models: a wave that one of them has absorbed is visible in the residual of another.
    """
    dataset = base.problem.dataset
    waiting = waiting_of(dataset)
    every = np.arange(dataset.data.t.size)
    residuals = [dataset.data.pv - model.simulated(every) for model in (base, *others)]
    dynamics = declared_effects(dataset, declared) if declared is not None else further_lags(dataset, base)
    return (
        *(() if waiting.follows else friction_effects(dataset)),
        *actuator_effects(dataset, update_grids(base, rows), step_grids(base, rows)),
        *time_proportioning(dataset, residuals),
        flow_delay(dataset),
        dead_time_jump(dataset),
        *process_effects(dataset, base),
        *dynamics,
        *disturbance_effects(dataset, residuals, [*jump_moments(base), *(at_s for at_s, _ in dataset.visible_jumps)]),
        *(() if waiting.sticks else (slow_wave(dataset),)),
        *sensor_hysteresis(dataset),
        *free_forms(dataset),
        *(effect for plugin in installed_effects().values() for effect in plugin.make(dataset, base)),
    )
