"""A process that integrates: where a tuning in manual leaves its PV is said, and true."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from autotuner.application.analysis.displacement import displacement_warning
from autotuner.core.model.process import Fopdt, Integrating
from autotuner.core.notes import Note
from autotuner.core.recording import Sample
from autotuner.ports import PV
from tests.control.conftest import Rig

LEVEL = {"structure": "integrating", "K": 0.05, "T": 0.0, "D": 1.0}


def record(outputs):
    """Samples of an integrator of K 0.05 and a dead time of 1 s from 50."""
    moved = np.concatenate(([0.0, 0.0], np.cumsum(0.05 * (np.array(outputs[:-2]) - 40.0))))
    return [Sample(float(k), 50.0 + moved[k], output) for k, output in enumerate(outputs)]


def test_by_hand():
    """40 s at 2 above the output at rest, K = 0.05: 4 PV units."""
    samples = record([40.0] * 30 + [42.0] * 40 + [40.0])
    text = displacement_warning(samples, Integrating(0.05, 0.0, 1.0), auto=False)
    assert "left +4 from 50," in text
    assert displacement_warning(samples, Integrating(0.05, 0.0, 1.0), auto=True) is None
    assert displacement_warning(samples, Fopdt(2.0, 10.0, 1.0), auto=False) is None
    assert displacement_warning(record([40.0] * 60), Integrating(0.05, 0.0, 1.0), auto=False) is None


def test_a_pv_that_drifted_when_it_was_found_is_a_note():
    """A load of 1 beside an output at rest: 0.05 a second: 5 in 100 s, less 0.475 to the middle of 20 samples."""
    samples = [replace(one, pv=one.pv + 0.05 * one.t) for one in record([40.0] * 30 + [42.0, 38.0] * 35 + [40.0])]
    text = displacement_warning(samples, Integrating(0.05, 0.0, 1.0), auto=False)
    assert "left +4.52 from 50.48" in text
    assert "drifted when the loop was found" in text
    assert isinstance(text, Note)
    still = displacement_warning(record([40.0] * 30 + [42.0] * 40 + [40.0]), Integrating(0.05, 0.0, 1.0), auto=False)
    assert not isinstance(still, Note)


def test_what_is_on_its_way_through_a_lag_counts_by_what_is_left_of_it():
    """After 100 s of a level 2 above rest and 100 s under it nothing is left, whatever the PV shows by then."""
    outputs, lagged, pv, samples = [40.0] * 30 + [42.0] * 100 + [38.0] * 100, 0.0, 50.0, []
    for k, output in enumerate(outputs):
        samples.append(Sample(float(k), pv, output))
        pv += 0.05 * lagged + 0.05 * (output - 40.0) * (1.0 - 80.0 * -np.expm1(-1.0 / 80.0))
        pv += 0.05 * (80.0 * -np.expm1(-1.0 / 80.0) - 1.0) * lagged
        lagged = (output - 40.0) + (lagged - (output - 40.0)) * np.exp(-1.0 / 80.0)
    assert samples[-1].pv > 54.0
    assert displacement_warning(samples, Integrating(0.05, 80.0, 0.0), auto=False) is None
    too_late = [*samples, *(Sample(230.0 + k, 50.0, 38.0) for k in range(5))]
    assert displacement_warning(too_late, Integrating(0.05, 80.0, 0.0), auto=False) is not None


def test_a_level_is_found_where_the_result_says(virtual):
    async def main():
        one = Rig(device={"plant": LEVEL, "pv0": 80.0, "noise": 0.02}, relay={"amplitude": 10.0, "check": False})
        await one.device.open()
        verdict = await one.conduct()
        await asyncio.sleep(20.0)
        return one, verdict, (await one.now(PV))[PV]

    one, verdict, pv = virtual(main())
    assert verdict.outcome == "done"
    told = [text for text in one.tuning.to_dict()["warnings"] if "integrates" in text]
    moved = float(told[0].partition("left ")[2].split()[0]) if told else 0.0
    assert moved == pytest.approx(pv - 80.0, abs=0.1)
