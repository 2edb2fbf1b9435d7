"""One measurement of the limit cycle: the streaming detector and its band-pass feed every estimate of it."""

import numpy as np
import pytest

from autotuner.core.identification.learned.correction import by_learned
from autotuner.core.identification.limit_cycle.from_cycle import Known, by_closed_form, by_describing_function
from autotuner.core.signals import detector as detectors
from autotuner.core.signals.detector import Detector
from autotuner.core.signals.limit_cycle import measure_limit_cycle, relay_switches, replayed
from autotuner_models.learned.artefacts import SHIPPED, load
from autotuner_sim import Fopdt, SopdtOverdamped

GAIN = Known(2.0, "given")
PLANTS = {"fopdt": Fopdt(2.0, 10.0, 3.0), "sopdt_overdamped": SopdtOverdamped(2.0, 10.0, 4.0, 3.0)}


@pytest.fixture(scope="module")
def models():
    return load(SHIPPED)


def judged(t, pv, output, switches):
    """The fundamental of the PV over that of the output, straight from the samples: the judge, no filter in it."""
    rows = slice(switches[0], switches[-1] + 1)
    w = 2.0 * np.pi / ((t[switches[-1]] - t[switches[0]]) / (len(switches) // 2))
    turns = np.exp(-1j * w * t[rows])
    driving = (output[rows][:-1] * np.diff(turns)).sum() / (-1j * w)
    return np.trapezoid((pv[rows] - pv[rows].mean()) * turns, t[rows]) / driving


@pytest.mark.parametrize("sigma", [0.0, 0.05])
def test_the_band_pass_leaves_the_response_as_the_samples_show_it(record_relay, sigma):
    record = record_relay(PLANTS["fopdt"], 0.1, low=-1.0, high=2.0, switches=15, sigma=sigma, hysteresis=3.0 * sigma)
    cycle = measure_limit_cycle(record)
    seen = relay_switches(record.output)
    expected = judged(record.t, record.pv, record.output, seen[-2 * cycle.cycles - 1 :])
    assert cycle.A1 / cycle.relay_fundamental == pytest.approx(abs(expected), rel=3e-3)
    assert cycle.lag_rad == pytest.approx(-np.angle(expected) % (2.0 * np.pi), abs=3e-3)


@pytest.mark.parametrize("structure", PLANTS)
def test_every_estimate_of_an_oscillation_changes_with_the_output_of_the_band_pass(
    record_relay, monkeypatch, models, structure
):
    """The band-pass answers with what it answered, times 1.2: so it is on the path of each estimate."""
    record = record_relay(PLANTS[structure], 0.1, low=-1.0, high=2.0, switches=13, quiet=40)

    def estimates():
        cycle = measure_limit_cycle(record)
        return (
            by_describing_function(cycle, GAIN, PLANTS[structure], structure),
            by_closed_form(cycle, GAIN, structure),
            by_learned(record, structure, (2.0, 0.0), models),
        )

    before = estimates()
    assert all(estimate.model is not None for estimate in before)
    honest = detectors.BandPass.run
    monkeypatch.setattr(detectors.BandPass, "run", lambda *words: [1.2 * value for value in honest(*words)])
    for one, other in zip(before, estimates(), strict=True):
        assert other.model is None or other.model.parameters() != pytest.approx(one.model.parameters(), rel=1e-2)


def test_a_live_detector_and_a_replayed_file_have_the_same_cycles(record_relay):
    """Fed with the same samples, as the experiment feeds it, the detector reports what the recording is read as."""
    record = record_relay(PLANTS["fopdt"], 0.1, low=-1.0, high=2.0, switches=11, quiet=40)
    live = Detector()
    switched_on = relay_switches(record.output)[0]
    for t, pv, output in zip(record.t[switched_on:], record.pv[switched_on:], record.output[switched_on:], strict=True):
        live.step(float(t), float(pv), bool(output > 0.5))
    read = replayed(record.t, record.pv, record.output, relay_switches(record.output))
    assert len(read) == len(live.cycles) + 1  # switched on from rest, a live relay has not switched yet
    assert read[1:] == live.cycles
    assert measure_limit_cycle(record).end_s == live.cycles[-1].end_s
