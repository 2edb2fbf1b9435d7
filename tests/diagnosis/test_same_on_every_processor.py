"""Another processor adds in another order: what differs in the last digits only decides nothing.

Rounding is imitated by relative changes of 1e-9, which is more than it makes and far less than any noise.
"""

from itertools import pairwise

import numpy as np
import pytest

from autotuner import Recording, diagnose, identify
from autotuner.core.diagnosis.effects import catalogue
from autotuner.core.diagnosis.effects.actuator.levels import _likeliest
from autotuner.core.diagnosis.extended.base import base_of
from autotuner.core.diagnosis.extended.extended_model import Fitted, closest_first, without_rounding
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.search.search import better_of, extend
from autotuner_sim import Backlash, OutputQuantisation
from tests.diagnosis.cases import PLANTS, tuning_record

pytestmark = pytest.mark.usefixtures("without_gains")

ROUNDING = 1e-9
SEEDS = range(20)


def rounded(values, random):
    return values * (1.0 + ROUNDING * random.uniform(-1.0, 1.0, np.shape(values)))


@pytest.mark.parametrize("scale", [1e-12, 1.0, -1e3], ids=["misfit of nothing", "misfit", "criterion"])
def test_equals_are_put_in_order_by_the_second_key_alone(scale):
    """Levels far apart hold items that are equal: whatever rounding and order, the level, then the key decides."""
    for seed in SEEDS:
        random = np.random.default_rng(seed)
        level = random.integers(0, 5, 30)
        misfit = rounded(scale * 1.01**level, random)
        order = random.permutation(30).tolist()
        ranked = without_rounding(order, lambda k, of=misfit: float(of[k]), lambda k: (k,))
        assert sorted(ranked) == list(range(30))
        for a, b in pairwise(ranked):
            assert (np.sign(scale) * level[a], a) < (np.sign(scale) * level[b], b)


def test_without_a_second_key_equals_stay_as_they_come():
    for seed in SEEDS:
        random = np.random.default_rng(seed)
        misfit = rounded(np.full(12, 3.0), random)
        assert without_rounding(range(12), lambda k, of=misfit: float(of[k])) == list(range(12))


def test_what_is_no_number_comes_last():
    misfits = [float("nan"), 2.0, float("inf"), 1.0, 0.0, 0.0]
    assert without_rounding(range(6), lambda k: misfits[k]) == [4, 5, 3, 1, 0, 2]
    assert without_rounding([], float) == []


def test_what_noise_tells_apart_is_not_the_same():
    """The misfit of `n` samples of noise is known to a share of sqrt(2/n): even of a million that is far more."""
    share = np.sqrt(2.0 / 1e6)
    assert without_rounding([1.0 + 0.01 * share, 1.0], float) == [1.0, 1.0 + 0.01 * share]


@pytest.fixture(scope="module")
def explained():
    """Return a record with play, as bench and as explanations of it."""
    record = tuning_record(PLANTS["balanced"], sigma=0.05, seed=7, actuators=[Backlash(3.0)])
    context = bench_of(dataset_of(record))
    base = base_of(context, ("offset",), 1)
    return context, extend(context, base.origins, catalogue(base.best, context.coarse, None))


def as_computed_elsewhere(fits, random):
    """Return fits in another order, their residuals as another processor leaves them."""
    other = [Fitted(f.problem, f.theta, f.linear, f.counts, rounded(f.residual, random)) for f in fits]
    return [other[k] for k in random.permutation(len(other))]


def same_misfit(fits):
    """Return the fits with one residual for all: what tells them apart is how plain they are."""
    return [Fitted(f.problem, f.theta, f.linear, f.counts, fits[0].residual) for f in fits]


@pytest.mark.parametrize("of", [list, same_misfit], ids=["as found", "all the same"])
def test_the_choice_among_explanations_is_the_same(explained, of):
    context, found = explained
    found = of(found)
    assert len(found) > 2

    def choices(fits):
        ranked = [[e.key for e in f.problem.effects] for f in closest_first(fits)]
        return ranked, *(pick(fits).problem.effects for pick in (context.best, lambda c: better_of(context, c)))

    expected = choices(found)
    for seed in SEEDS:
        assert choices(as_computed_elsewhere(found, np.random.default_rng(seed))) == expected


def test_of_explanations_as_close_the_one_of_fewer_numbers_comes_first(explained):
    _, found = explained
    sizes = [f.size + f.price for f in closest_first(same_misfit(found))]
    assert sizes == sorted(sizes)


def test_of_plateaus_as_high_the_widest_is_first_and_taken_in_its_middle():
    steps = np.geomspace(0.01, 0.6, 1500)
    narrow, wide, lower = slice(200, 206), slice(700, 741), slice(1100, 1300)
    for seed in SEEDS:
        random = np.random.default_rng(seed)
        fall = np.linspace(0.0, 1.0, 1500) % 0.013
        fall[narrow], fall[wide], fall[lower] = 7.0, 7.0, 6.0
        found = _likeliest(rounded(fall, random), steps, np.zeros(1500))
        assert [step for step, _ in found] == [steps[720], steps[202], steps[1199]]


@pytest.mark.long  # growth by itself, below
@pytest.mark.parametrize(
    "sigma", [pytest.param(0.0, marks=pytest.mark.long, id="without noise"), pytest.param(0.05, id="with noise")]
)
def test_the_answer_is_that_of_the_record_whose_last_digits_differ(sigma, among):
    among("output_quantisation", "backlash", "stiction", "actuator_hold")
    record = tuning_record(PLANTS["balanced"], sigma=sigma, seed=1, actuators=[OutputQuantisation(1.7)])
    moved = rounded(record.pv, np.random.default_rng(2))
    one, other = diagnose(record), diagnose(Recording(record.t, record.output, moved, settings=record.settings))
    assert (one.verdict, [e.name for e in one.effects]) == (other.verdict, [e.name for e in other.effects])
    for mine, theirs in zip(one.effects, other.effects, strict=True):
        assert mine.parameters == pytest.approx(theirs.parameters, rel=1e-3)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2, 3))])
def test_growth_by_itself_is_no_answer_whatever_its_last_digits(seed):
    """The record is the background's alone but for a thousand roundings of a sample."""
    t = np.arange(400.0)
    pv = np.exp(0.03 * t) * (1.0 + 1e-13 * np.random.default_rng(seed).uniform(-1.0, 1.0, t.size))
    assert identify(Recording(t, (t >= 100.0).astype(float), pv)).verdict.code == "no_answer"
