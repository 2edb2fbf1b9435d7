"""What has no name is described: shares of what is missing, against residuals whose cause is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis import diagnose as search
from autotuner.core.diagnosis.extended.base import base_of
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.findings.residual_dependence import _share, dependences, in_words
from autotuner.core.diagnosis.record.dataset import dataset_of

pytestmark = pytest.mark.usefixtures("without_gains")

SIGMA = 0.02


def record(extra, n=1200):
    """A lag of 10 s under random steps, with something added to the reading that is a function of one variable."""
    random = np.random.default_rng(3)
    output = 40.0 + np.repeat(random.uniform(-8.0, 8.0, n // 30), 30)
    output[:30] = 40.0
    pv = np.zeros(n)
    for k in range(1, n):
        pv[k] = pv[k - 1] + (2.0 * (output[k - 1] - 40.0) - pv[k - 1]) * -np.expm1(-0.1)
    t = np.arange(float(n))
    return Recording(
        t, output, 80.0 + pv + extra(SimpleNamespace(t=t, u=output - 40.0, y=pv)) + random.normal(0.0, SIGMA, n)
    )


def missing_of(extra):
    context = bench_of(dataset_of(record(extra)))
    base = base_of(context, ("offset",), 0)
    return dependences(context, base.best, SIGMA)


@pytest.mark.parametrize(
    ("variable", "shape", "extra"),
    [
        ("PV", "like its square", lambda r: 0.01 * r.y**2),
        ("time", None, lambda r: 2.0 * (r.t / 1200.0) ** 2),
        ("output", "like its square", lambda r: 0.02 * r.u**2),
    ],
)
def test_the_variable_behind_a_residual_comes_first(variable, shape, extra):
    found = missing_of(extra)
    assert found[0].variable == variable
    assert found[0].share > 0.5
    assert shape in {None, found[0].shape}
    words = " ".join(in_words(found))
    assert f"depends on the {variable} alone" in words
    assert "would show more" in words


def test_nothing_is_said_of_noise():
    assert missing_of(lambda _: 0.0) == ()
    assert in_words(()) == []


def unnamed():
    """Return a record whose reading jumps to and fro at random, for which the catalogue has no name."""
    random = np.random.default_rng(8)
    beats = np.cumsum(random.random(1200) < 0.04) % 2 * random.choice([0.4, 1.1], 1200)
    return record(lambda _: beats)


def test_an_unexplained_record_carries_the_description():
    """Whatever a search would find: here there is no time for one."""
    found = search(unnamed(), is_spent=lambda: True)
    assert found.verdict == "unexplained"
    told = found.to_dict()
    assert {row["variable"] for row in told["missing"]} >= {"output", "PV", "time"}
    assert any("what is missing" in note for note in found.notes)


@pytest.mark.long  # the description is in the test above
def test_jumps_to_and_fro_at_random_have_no_name():
    assert diagnose(unnamed()).verdict in {"unexplained", "partly_explained"}


def test_an_output_of_two_levels_has_no_curve():
    """A relay's output tells a straight line at most; nothing warns."""
    x = np.tile([0.0, 1.0], 100)
    share, shape = _share(x, 2.0 * x, np.arange(200) < 100)
    assert share == pytest.approx(1.0)
    assert shape == "in proportion"


def test_levels_that_differ_by_rounding_give_no_warning():
    """They count as many levels, and no polynomial separates them."""
    random = np.random.default_rng(5)
    output = np.repeat([0.0, 1.0], 100) + random.uniform(0.0, 1e-16, 200)
    learned = np.arange(200) % 2 == 0
    share, _ = _share(output, 3.0 * (output > 0.5) + random.normal(0.0, 0.1, 200), learned)
    assert share == pytest.approx(1.0, abs=0.02)
