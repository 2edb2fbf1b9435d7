"""What rounding stands for: an effect without which the PV lies within the readings is not needed."""

import math

import numpy as np
import pytest

from autotuner import Recording
from autotuner.core.diagnosis.effects.actuator.saturation import saturations
from autotuner.core.diagnosis.effects.disturbance import disturbance_effects
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.findings.sensor_effects import sensor_findings
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.record.sensor import SensorRecord, grid_of
from autotuner.core.diagnosis.search.search import refined
from autotuner.core.diagnosis.search.trace import Trace
from tests.diagnosis.simulated import LAG, OUTPUT0, at_the_truth, moves, of_form, record


def test_an_effect_that_rounding_stands_for_is_not_needed():
    """A limit of the output, and a drift that is none: without it the PV lies within the rounded readings."""
    output = moves(600, hold=20)
    clipped = record(LAG, np.minimum(output, 5.0))
    step = 0.08 * float(np.ptp(clipped.pv))
    rounded = Recording(clipped.t, OUTPUT0 + output, step * np.round(clipped.pv / step))
    dataset = dataset_of(rounded, grid_noise=step / math.sqrt(12.0))
    context = bench_of(dataset)
    limit = of_form(saturations(dataset), "saturation:high")
    drift = next(e for e in disturbance_effects(dataset, [dataset.data.pv], []) if e.key == "drift")
    at = (float(output.max()) - 5.0) / dataset.swing
    chosen = refined(context, at_the_truth(rounded, LAG, (limit, [at]), (drift, []), dataset=dataset))
    alone = at_the_truth(rounded, LAG, dataset=dataset)
    none = np.zeros(rounded.t.size, dtype=np.bool_)
    sensor = SensorRecord(none, none, grid_of(rounded.pv))
    (finding,), found = sensor_findings(context, Trace(alone, chosen, (chosen,), 0.0), sensor)
    assert finding.effect.name == "sensor_quantisation"
    assert found.chosen.names == ("saturation",)
    assert pytest.approx(LAG.K, rel=0.02) == found.chosen.process().K
