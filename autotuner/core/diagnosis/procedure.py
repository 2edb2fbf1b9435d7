"""Diagnosis of a recording, with or without a declared model."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from autotuner.core.diagnosis.effects import catalogue
from autotuner.core.diagnosis.effects.actuator.friction import SLIPS
from autotuner.core.diagnosis.extended.base import Base, base_of, declared_base, is_the_controller
from autotuner.core.diagnosis.extended.coloured_noise import beside_a_load, is_noise_instead
from autotuner.core.diagnosis.extended.fit_context import FitContext, bench_of
from autotuner.core.diagnosis.extended.repair import require_not_swapped, without_gaps
from autotuner.core.diagnosis.findings.gain_comparison import NOMINAL
from autotuner.core.diagnosis.findings.report import reported
from autotuner.core.diagnosis.findings.sensor_effects import explained_by_grid
from autotuner.core.diagnosis.record.budget import UNLIMITED, Budget
from autotuner.core.diagnosis.record.dataset import AT_REST_FIRST, COLD, dataset_of
from autotuner.core.diagnosis.record.parts import parts_of
from autotuner.core.diagnosis.record.sensor import (
    FEWEST_ELSEWHERE,
    FEWEST_NEW,
    SensorRecord,
    frozen,
    grid_of,
    new_readings,
    spikes_of,
)
from autotuner.core.diagnosis.search.acceptance import is_noise
from autotuner.core.diagnosis.search.joint.late_moves import with_own_times
from autotuner.core.diagnosis.search.judge import VISIBLE, held_out, noise_of
from autotuner.core.diagnosis.search.measured_disturbances import with_known
from autotuner.core.diagnosis.search.trace import Trace, trace
from autotuner.core.diagnosis.search.uneven_sampling import (
    is_from_sample_to_sample,
    jitter_seen,
    jittered_moves,
    sampled_unevenly,
)
from autotuner.core.estimation.decimate import condensed
from autotuner.core.identification import advice
from autotuner.core.identification.controller_inverse import controller_of
from autotuner.core.signals.feedback import process_sign, set_point_moves
from autotuner.core.signals.noise import rms
from autotuner.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.findings.gain_comparison import Design
    from autotuner.core.diagnosis.findings.result import Diagnosis
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.diagnosis.record.sensor import Grid
    from autotuner.core.identification.controller_inverse import Controller
    from autotuner.core.model.arrays import BoolArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

MOST_SAMPLES = 6000
"""Most samples that a diagnosis computes with; longer records are condensed where the PV is smooth."""
CORNER, JUMP = 4.0, 0.1
"""Samples after a move of the output that belong to it, and move of a further column, in its range, that is one."""
LATE = 2.0
"""Misfit over noise of the part not fitted from which a model fails on it."""
LEAST_SHARE, MOST_SHARE = 0.2, 0.8
"""Least and most of it that is fitted where only that part decides."""
LEFT_OPEN = "what decides shows after the fitted part only: some of what follows was fitted, too, and the rest judged"
NO_DELAY, FAR_CLOSER = 0.05, 0.7
"""Dead time, in samples, that counts as zero, and ratio of the errors below which the output is not held."""
SMOOTH = "the output is taken to move smoothly between its samples: held from each to the next, it comes too late"
QUICKEST = 0.995
"""Quantile of the simulated moves between two samples that counts as the quickest."""
DELTA_NOISE, GRID_NOISE = 0.6, 1.0 / math.sqrt(12.0)
"""Standard deviation of a sensor's error in its steps: that reports on change, that rounds."""


def diagnose(
    recording: Recording,
    model: ProcessModel | None = None,
    *,
    requested: Design = NOMINAL,
    is_spent: Callable[[], bool] | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Return the effects that a recording shows and a model lacks: their sizes, evidence, and influence on the gains.

    Parameters
    ----------
    recording : Recording
        Output and PV: a tuning's own record, a step test, a historian's CSV.
    model : ProcessModel, optional
        The declared model; without it the process is identified from the same record.
    requested : Design
        Design of the gains before and after; by default those of the goal ``balanced``.
    is_spent : callable, optional
        Returns whether the time limit of the search has passed. The search then ends as `unexplained`, with the best so
        far; the process alone and the report are computed in any case.
    on_progress : callable, optional
        Called with a sentence on the progress of the search.

    Returns
    -------
    Diagnosis
        See there.

    Raises
    ------
    RecordingError
        A record that cannot show a process, with the reason and a remedy.
    """
    if verdict := advice.unusable(recording):
        raise RecordingError(verdict.message, field="recording", remedy=verdict.remedy)
    parts = parts_of(condensed(without_gaps(recording), MOST_SAMPLES))
    if verdict := advice.unusable(parts.before_test):
        raise RecordingError(verdict.message, field="recording", remedy=verdict.remedy)
    require_not_swapped(parts.before_test)
    record, first = replace(
        _Record.of(parts.before_test, model), budget=Budget(is_spent, on_progress)
    ).with_input_between()
    record, first = record.with_beginning(first)
    if record.smooth:
        parts = replace(parts, whole=replace(parts.whole, notes=(*parts.whole.notes, SMOOTH)))
    record, (context, base, found, spikes) = record.searched(first)
    if record.tail_share > 0.0:
        parts = replace(parts, whole=replace(parts.whole, notes=(*parts.whole.notes, LEFT_OPEN)))
    if is_the_controller(found.chosen) or (is_the_controller(base.best) and not SLIPS & set(found.chosen.names)):
        verdict = advice.controller_instead()
        raise RecordingError(verdict.message, field="recording", remedy=verdict.remedy)
    return reported(context, found, SensorRecord(spikes, record.stands, record.grid), base, model, parts, requested)


class _Searched(NamedTuple):
    """A search, with its samples, the process alone on all of them, and the spikes."""

    context: FitContext
    base: Base
    trace: Trace
    spikes: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _Record:
    """Properties of a recording before the first fit."""

    used: Recording
    model: ProcessModel | None
    sign: int
    stands: BoolArray
    grid: Grid | None
    tail_share: float = 0.0
    smooth: bool = False
    begins: str = ""
    budget: Budget = UNLIMITED
    controller: Controller | None = None

    @classmethod
    def of(cls, used: Recording, model: ProcessModel | None) -> _Record:
        stands = frozen(used.pv, int(np.argmax(used.output != used.output[0])))
        controller = controller_of(used)
        sign = process_sign(used) or (0 if controller is None else controller.sign_of_process)
        return cls(used, model, sign, stands, grid_of(used.pv), controller=controller)

    def context(self, spikes: BoolArray | None = None) -> FitContext:
        grid, left_out = self.grid, self.stands if spikes is None else self.stands | spikes
        grid_noise = 0.0 if grid is None else grid.step * (GRID_NOISE if grid.rounded else DELTA_NOISE)
        dataset = dataset_of(self.used, left_out, grid_noise, self.tail_share, smooth=self.smooth, begins=self.begins)
        if grid is not None and grid.sends:
            dataset = _of_new_readings(dataset, new_readings(self.used.pv))
        controller = None if dataset.tuned else self.controller
        return bench_of(replace(dataset, budget=self.budget, controller=controller))

    def based(self, spikes: BoolArray | None = None) -> tuple[FitContext, Base]:
        context = self.context(spikes)
        return context, _base(context, self.sign, self.model)

    def with_input_between(self) -> tuple[_Record, tuple[FitContext, Base]]:
        """Return the same, with the process alone; with an output that moves smoothly where that is far closer.

        An output that is held for a sample comes half a sample later on average, and no dead time is negative.
        """
        context, first = self.based()
        _, delay_s, _ = first.best.problem.split(first.best.theta)
        if not context.dataset.in_loop or delay_s > NO_DELAY * context.dataset.data.interval_s:
            return self, (context, first)
        smooth = replace(self, smooth=True)
        between = smooth.based()
        return (smooth, between) if between[1].best.rms < FAR_CLOSER * first.best.rms else (self, (context, first))

    def with_beginning(self, first: tuple[FitContext, Base]) -> tuple[_Record, tuple[FitContext, Base]]:
        """Return the same that begins at rest, or cold, where that is closer on both parts than from any state.

        A free initial state absorbs what a further column of the record explains.
        """
        dataset = first[0].dataset
        if dataset.settled_first or dataset.in_loop or not dataset.extra or self.model is not None:
            return self, first
        ways = ("", AT_REST_FIRST, *((COLD,) if self.used.output[0] else ()))
        based = {way: replace(self, begins=way).based() if way else first for way in ways}
        known = {
            way: (context, with_known(context, base.best, catalogue(base.best, context.coarse)).best)
            for way, (context, base) in based.items()
        }
        inflated = min(context.colour(fitted) for context, fitted in known.values())
        free_bench, free = known[""]
        simpler = [
            way
            for way, (context, fitted) in known.items()
            if context.criterion(fitted, inflated) < free_bench.criterion(free, inflated)
            and context.on_both_parts(fitted) < free_bench.on_both_parts(free)
        ]
        best = min(simpler, key=lambda way: known[way][0].on_both_parts(known[way][1]), default="")
        return replace(self, begins=best), based[best]

    def searched(self, first: tuple[FitContext, Base]) -> tuple[_Record, _Searched]:
        """Return the record with as much of it fitted as decides, and the search on that.

        A search that leaves the answer to more samples goes on with those at once, and comes back where they leave it
        open too.
        """
        found = self.traced(*first, patient=False)
        if not found.trace.complete and not found.context.dataset.budget.spent:
            more, again = self._on_more(found, patient=False)
            if again is not None and again.trace.complete and is_noise(again.context, again.trace.chosen):
                return more, again
            found = self.traced(*first)
        more, again = self._on_more(found)
        return (self, found) if again is None else (more, again)

    def _on_more(self, found: _Searched, *, patient: bool = True) -> tuple[_Record, _Searched | None]:
        """Return the record with more of it fitted, and the search on that; None where it explains no more."""
        share = _share_that_decides(found.context, found.trace)
        if share == 0.0 or found.context.dataset.budget.spent:
            return self, None
        more = replace(self, tail_share=share)
        again = more.traced(*more.based(), [*found.trace.pool, found.trace.chosen], patient=patient)
        return more, again if _replaces(found, again) else None

    def traced(
        self, context: FitContext, first: Base, earlier: Sequence[Fitted] = (), *, patient: bool = True
    ) -> _Searched:
        """Return the search on the samples, which leave out spikes.

        `earlier` has explanations that were found on fewer samples; `patient` is that of `trace`.
        """
        none = np.zeros(self.used.t.size, dtype=np.bool_)
        if self._of_the_sensor(context, first):
            return _Searched(context, first, Trace(first.alone, first.best, (), noise_of(context, first.best)), none)
        spikes = _spikes(context, first.best) & ~self.stands
        context, base = self.based(spikes) if spikes.any() else (context, first)
        found = trace(context, base, self.model, earlier, patient=patient)
        if not found.complete:
            return _Searched(context, first, found, spikes)
        late = _spikes(context, found.chosen) & ~self.stands & ~spikes
        # Where moves arrive late, the residual at them comes from corners of the model, not of the sensor.
        timed = any(effect.group == "timing" for effect in found.chosen.problem.effects)
        if late.any() and not timed and not _at_moves(context, found.chosen, late) and found.chosen is not base.best:
            spikes = spikes | late
            context, base = self.based(spikes)
            found = trace(context, base, self.model, earlier)
        jittered = self._jittered(first, found, spikes)
        if jittered is not None:
            return _Searched(*jittered, none)
        return _Searched(context, first, self._with_load(context, base, found), spikes)

    def _with_load(self, context: FitContext, base: Base, found: Trace) -> Trace:
        """Return the process of a loop beside a large load, where its innovations need none of the effects."""
        loaded = None
        if base.held is None and set_point_moves(self.used):
            loaded = beside_a_load(context, base.best, self.sign)
        if loaded is None or not is_noise_instead(context, loaded, found.chosen):
            return found
        return replace(found, alone=loaded, chosen=loaded)

    def _jittered(self, first: Base, found: Trace, spikes: BoolArray) -> tuple[FitContext, Base, Trace] | None:
        """Return the trace of an experiment with uneven times of both samples and moves; None otherwise."""
        explained = found.chosen.rms < VISIBLE * found.noise and "actuator_hold" not in found.chosen.names
        in_loop = first.best.problem.dataset.in_loop
        if in_loop or first.held is not None or (explained and not found.chosen.names):
            return None
        context = self.context()
        if explained and not sampled_unevenly(context, first.best):
            return None
        known = [c for c in found.pool if any(e.form == "uneven" and e.unseen_after for e in c.problem.effects)]
        timed = known if known and not spikes.any() else with_own_times(context, first)
        chosen = jittered_moves(context, timed[0]) if timed else None
        return (
            None if chosen is None else (context, first, replace(found, chosen=chosen, noise=noise_of(context, chosen)))
        )

    def _of_the_sensor(self, context: FitContext, base: Base) -> bool:
        """Return whether the sensor alone accounts for the residual: quantisation, or uneven sampling."""
        if self.grid is not None:
            return explained_by_grid(context, base.best, self.grid)
        jitter = jitter_seen(context, base.best) if base.held is None else None
        if jitter is None or not is_from_sample_to_sample(context, base.best, *jitter):
            return False
        return _predicts_later(context, base.best, *jitter)


def _of_new_readings(dataset: Dataset, new: BoolArray) -> Dataset:
    """Return the dataset with only readings that a sensor has just sent; as it is where these are too few.

    Repeated ones lag behind the PV like play: fitted as measurements, they make the gain too small.
    """
    fitted, held_out = dataset.fitted & new, dataset.held_out & new
    enough = np.count_nonzero(fitted) >= FEWEST_NEW and np.count_nonzero(held_out) >= FEWEST_ELSEWHERE
    return replace(dataset, fitted=fitted, held_out=held_out) if enough else dataset


def _predicts_later(context: FitContext, candidate: Fitted, spread_s: float, noise: float) -> bool:
    """Return whether uneven sampling accounts for the error on the part that was not fitted, too."""
    t = context.dataset.data.t
    slope = np.gradient(candidate.simulated(np.arange(t.size)), t)[context.held_out]
    return context.held_out_error(candidate) < LATE * math.hypot(noise, spread_s * rms(slope))


def _at_moves(context: FitContext, candidate: Fitted, rows: BoolArray) -> bool:
    """Return whether most of the samples follow right on moves of the output: corners of the model."""
    dataset = context.dataset
    _, delay_s, _ = candidate.problem.split(candidate.theta)
    columns = [np.flatnonzero(np.abs(np.diff(v)) > JUMP * np.ptp(v)) + 1 for v in dataset.extra.values()]
    jumps = [dataset.data.t[at] for at in columns]
    arrives = np.sort(np.concatenate([dataset.data.held.times[1:] + delay_s, *jumps]))
    t = dataset.data.t[rows]
    last = np.searchsorted(arrives, t + dataset.data.interval_s, side="right") - 1
    since = np.where(last < 0, np.inf, t - arrives[np.maximum(last, 0)])
    return bool(np.mean(since < CORNER * dataset.data.interval_s) > 0.5)


def _left_in_all(found: Trace) -> float:
    """Return the error of the explanation on all samples that are measurements, PV."""
    dataset = found.chosen.problem.dataset
    rows = np.flatnonzero(dataset.fitted | dataset.held_out)
    return rms(dataset.data.pv[rows] - found.chosen.simulated(rows))


def _replaces(found: _Searched, again: _Searched) -> bool:
    """Return whether what was fitted to more of the record explains all of it better, with the same sign.

    That is effects, or the process alone: its numbers may only have been unsure. Where the processes alone differ in
    sign, those beside effects decide, if these leave only noise.
    """
    fewer, later = found.trace, again.trace
    one_sign = _same_sign(found.base.best, again.base.best) or (
        is_noise(again.context, later.chosen) and _same_sign(fewer.chosen, later.chosen)
    )
    return one_sign and _is_as_good_later(again.context, later) and _left_in_all(later) < _left_in_all(fewer)


def _same_sign(first: Fitted, second: Fitted) -> bool:
    return float(first.linear[0]) * float(second.linear[0]) > 0.0


def _is_as_good_later(context: FitContext, found: Trace) -> bool:
    """Return whether the explanation is as good on the held-out part as on the other, or leaves noise there."""
    return rms(held_out(context, found.chosen)[0]) <= LATE * max(found.noise, found.chosen.rms)


def _share_that_decides(context: FitContext, found: Trace) -> float:
    """Return the share of the part not fitted that has to be fitted too, 0 for none of it.

    That is so where something follows the fitted part and fails on the other: what is missing shows there only, or
    several sizes of it (steps that round the fitted levels alike) are one until then. Up to the moment at which half of
    the squared misfit has come, it decides; the rest judges.
    """
    near = [c for c in (*found.pool, found.chosen) if c.rms < VISIBLE * found.noise]
    if not near or context.held_out_error(found.chosen) <= LATE * found.noise:
        return 0.0
    came = np.cumsum(context.held_out_residual(context.best(near)) ** 2)
    t = context.dataset.data.t[context.held_out]
    half_s = float(t[np.searchsorted(came, came[-1] / 2.0)])
    return float(np.clip((half_s - t[0]) / (t[-1] - t[0]), LEAST_SHARE, MOST_SHARE))


def _spikes(context: FitContext, candidate: Fitted) -> BoolArray:
    rows = np.arange(context.dataset.data.t.size)
    if context.dataset.grid_noise > context.dataset.noise:
        return np.zeros(rows.size, dtype=np.bool_)
    simulated = candidate.simulated(rows)
    motion = float(np.quantile(np.abs(np.diff(simulated)), QUICKEST))
    return spikes_of(
        context.dataset.data.pv - simulated, max(context.dataset.noise, 3.0 * context.dataset.floor), motion
    )


def _base(context: FitContext, sign: int, model: ProcessModel | None) -> Base:
    dataset = context.dataset
    background = ("offset",) if dataset.settled_first else ("offset", "state")
    base = None if model is None else declared_base(context, background, sign, model)
    base = base_of(context, background, sign) if base is None else base
    if base is None:
        remedy = "Check that output and PV belong together."
        raise RecordingError("no process comes near it", field="recording", remedy=remedy)
    return base
