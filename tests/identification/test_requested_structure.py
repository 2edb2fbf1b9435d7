"""A structure that was asked for, on a recording that shows another one."""

import re

import numpy as np
import pytest

from autotuner.core.identification import identify
from autotuner_sim.plants import Fopdt, SopdtOverdamped

GIVEN = (2.0, 10.0, 3.0)


@pytest.fixture
def step(record):
    """A step of the output upon a process that settles, seen for so many samples."""

    def made(samples, plant=None):
        plant = Fopdt(*GIVEN) if plant is None else plant
        return record(plant, 1.0, lambda k, _: float(k >= 20), samples, sigma=0.005)

    return made


@pytest.mark.parametrize("samples", [120, 240])
def test_an_integrator_of_the_wrong_sign_is_refused_with_what_the_record_shows(step, samples):
    found = identify(step(samples), structure="integrating")
    assert (found.model, found.verdict.code) == (None, "structure_does_not_fit")
    shown = re.search(r"fopdt \(K ([\d.]+), T ([\d.]+), D ([\d.]+)\)", found.verdict.message)
    assert [float(value) for value in shown.groups()] == pytest.approx(GIVEN, rel=0.03)
    assert "ask for fopdt" in found.verdict.remedy


@pytest.mark.parametrize("structure", ["integrating", "unstable_fopdt"])
@pytest.mark.parametrize(("plant", "sigma"), [(Fopdt(2.0, 5.0, 3.0), 0.01), (Fopdt(2.0, 10.0, 0.5), 0.05)])
def test_a_dead_time_that_leaves_only_the_settled_pv_is_no_way_out(record, structure, plant, sigma):
    settled = record(plant, 0.2, lambda k, _: float(k >= 25), 300, sigma=sigma)
    found = identify(settled, structure=structure)
    assert (found.model, found.verdict.code) == (None, "structure_does_not_fit")
    assert "ask for fopdt" in found.verdict.remedy


def test_a_structure_that_leaves_far_more_is_given_with_what_the_record_shows(step):
    found = identify(step(60), structure="integrating")
    assert found.model.K > 0.0
    assert "the recording shows fopdt" in found.warnings[0]


@pytest.mark.parametrize("samples", [60, 240])
def test_nothing_is_said_of_the_structure_that_the_record_shows(step, samples):
    assert not any("was asked for" in said for said in identify(step(samples), structure="fopdt").warnings)


def test_a_simpler_structure_is_given_on_purpose(step):
    found = identify(step(240, SopdtOverdamped(2.0, 12.0, 6.0, 3.0)), structure="fopdt")
    assert found.model.parameters()["K"] == pytest.approx(2.0, rel=0.03)
    assert "the recording shows sopdt_overdamped" in found.warnings[0]


def test_what_is_no_answer_to_the_output_is_not_shown_instead(step):
    still = step(240)
    alone = type(still)(still.t, still.output, np.sin(still.t / 7.0))
    assert identify(alone, structure="integrating").verdict.code != "structure_does_not_fit"
