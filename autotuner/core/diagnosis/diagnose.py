"""From a recording, and a model if there is one, to a diagnosis."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.base import Base, base_of, declared_base
from autotuner.core.diagnosis.bench import Bench, bench_of
from autotuner.core.diagnosis.case import case_of
from autotuner.core.diagnosis.report import reported
from autotuner.core.diagnosis.sensor import SensorRecord, frozen, grid_of, spikes_of
from autotuner.core.diagnosis.trace import trace
from autotuner.core.identification import advice
from autotuner.core.identification.condense import condensed
from autotuner.core.signals.feedback import process_sign
from autotuner.errors import RecordingError

if TYPE_CHECKING:
    from autotuner.core.arrays import BoolArray
    from autotuner.core.diagnosis.extended import Fitted
    from autotuner.core.diagnosis.result import Diagnosis
    from autotuner.core.process import ProcessModel
    from autotuner.core.recording import Recording

MOST_SAMPLES = 6000
DELTA_NOISE, GRID_NOISE = 0.6, 1.0 / math.sqrt(12.0)
"""Standard deviation of a sensor's error in its steps: that reports on change, that rounds."""


def diagnose(recording: Recording, model: ProcessModel | None = None) -> Diagnosis:
    """Say whether a model lacks anything that a recording shows; if so what, how big, how sure, and what it changes.

    Parameters
    ----------
    recording : Recording
        Output and PV: a tuning's own record, a step test, a historian's CSV.
    model : ProcessModel, optional
        The declared model; without it the process is identified from the same record.

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
    used = condensed(recording, MOST_SAMPLES)
    sign = process_sign(used)
    stands = frozen(used.pv, int(np.argmax(used.output != used.output[0])))
    grid = grid_of(used.pv)
    grid_noise = 0.0 if grid is None else grid.step * (GRID_NOISE if grid.rounded else DELTA_NOISE)
    bench = bench_of(case_of(used, stands, grid_noise))
    base = _base(bench, sign, model)
    first = base
    spikes = _spikes(bench, base.best) & ~stands
    if spikes.any():
        bench = bench_of(case_of(used, stands | spikes, grid_noise))
        base = _base(bench, sign, model)
    found = trace(bench, base, model)
    late = _spikes(bench, found.chosen) & ~stands & ~spikes
    if late.any() and found.chosen is not base.best:
        spikes = spikes | late
        bench = bench_of(case_of(used, stands | spikes, grid_noise))
        base = _base(bench, sign, model)
        found = trace(bench, base, model)
    return reported(bench, found, SensorRecord(spikes, stands, grid), first, model, used)


def _spikes(bench: Bench, candidate: Fitted) -> BoolArray:
    rows = np.arange(bench.case.data.t.size)
    if bench.case.grid_noise > bench.case.noise:
        return np.zeros(rows.size, dtype=np.bool_)
    return spikes_of(bench.case.data.pv - candidate.simulated(rows), max(bench.case.noise, 3.0 * bench.case.floor))


def _base(bench: Bench, sign: int, model: ProcessModel | None) -> Base:
    case = bench.case
    background = ("offset",) if case.settled_first else ("offset", "state")
    base = None if model is None else declared_base(bench, background, sign, model)
    base = base_of(bench, background, sign) if base is None else base
    if base is None:
        remedy = "Check that output and PV belong together."
        raise RecordingError("no process comes near it", field="recording", remedy=remedy)
    return base
