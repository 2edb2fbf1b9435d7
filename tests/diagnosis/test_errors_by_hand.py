"""Errors by part, shares of a residual, evidence and coincidence, of models whose residuals are written down."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner import Recording
from autotuner.core.diagnosis.extended.effect import Place
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.findings.errors_by_part import Errors
from autotuner.core.diagnosis.findings.residual_dependence import dependences, in_words
from autotuner.core.diagnosis.record.dataset import Dataset, dataset_of
from autotuner.core.diagnosis.record.parts import parts_of
from autotuner.core.diagnosis.search import simplify
from autotuner.core.diagnosis.search.coincidence import answers_a_move
from autotuner.core.diagnosis.search.judge import held_out_gain, weigh, weighs_enough
from autotuner.core.diagnosis.search.search import best_on_both_parts
from autotuner.core.diagnosis.search.uneven_sampling import jitter_of, unevenness_of
from autotuner.core.model.structures import FOPDT, INTEGRATING, Structure

N = 1000
T = np.arange(float(N))
FITTED, SELECTED, TESTED = slice(0, 600), slice(600, 800), slice(800, N)
WHITE = np.random.default_rng(31).standard_normal((4, N))


@dataclass(frozen=True, eq=False)
class Problem:
    dataset: Dataset | None = None
    rows: np.ndarray | None = None
    effects: tuple = ()
    structure: Structure = FOPDT

    def split(self, theta):
        return [], 0.0, []


@dataclass(frozen=True, eq=False)
class Model:
    """A model that simulates a given curve, about the PV of the dataset."""

    problem: Problem
    curve: np.ndarray
    residual: np.ndarray
    size: int = 3
    price: float = 0.0
    theta: tuple = ()
    keys: tuple = ()

    def on(self, dataset):
        return replace(self, problem=replace(self.problem, dataset=dataset))

    def simulated(self, rows):
        return self.curve[rows]

    @property
    def mean_square(self):
        return float(np.mean(self.residual**2))

    misfit = mean_square

    @property
    def rms(self):
        return math.sqrt(self.mean_square)


def seen_of(pv, output=None):
    """The parts of a record, and the context of what is seen of it."""
    output = 40.0 + np.repeat(np.resize([0.0, 5.0, -5.0], N // 50), 50)[: pv.size] if output is None else output
    parts = parts_of(Recording(T[: pv.size], output, pv))
    return parts, bench_of(dataset_of(parts.before_test))


def model_of(context, pv, residual, structure=FOPDT, **told):
    """The model that leaves just this residual of the PV."""
    curve = pv - context.dataset.pv0 - residual
    rows = context.fine
    return Model(Problem(rows=rows, structure=structure), curve, (pv - context.dataset.pv0 - curve)[rows], **told)


COURSE = 70.0 + 10.0 * np.sin(T / 60.0)


def by_parts(fitted, selected, tested, later=None):
    """A residual of equal size and alternating sign in each part."""
    sizes = np.empty(N)
    sizes[FITTED], sizes[SELECTED], sizes[TESTED] = fitted, selected, tested
    sizes[700:800] = selected if later is None else later
    return sizes * np.where(np.arange(N) % 2, -1.0, 1.0)


# ------------------------------------------------------------------------------------------------------------ errors


def errors_of(before, after, noise=0.5, spread_s=0.0, pv=COURSE):
    parts, context = seen_of(pv)
    return Errors(context, parts, model_of(context, pv, before), model_of(context, pv, after), noise, spread_s)


def test_each_part_has_its_own_error():
    found = errors_of(by_parts(4.0, 6.0, 8.0), by_parts(1.0, 2.0, 3.0)).by_part()
    figures = {name: (misfit.before, misfit.after) for name, misfit in found.items()}
    expected = {"fitted": (4.0, 1.0), "selection": (6.0, 2.0), "held_out": (8.0, 3.0)}
    assert {name: pytest.approx(values) for name, values in expected.items()} == figures
    assert {misfit.noise for misfit in found.values()} == {misfit.expected for misfit in found.values()} == {0.5}


def test_the_later_half_of_the_selection_is_judged_alone():
    found = errors_of(by_parts(1.0, 3.0, 9.0, later=4.0), by_parts(1.0, 1.0, 9.0, later=2.0))
    later = found.of_the_later_selection()
    assert (later.before, later.after) == pytest.approx((4.0, 2.0))
    both = found.by_part()["selection"]
    assert (both.before, both.after) == pytest.approx((math.sqrt(12.5), math.sqrt(2.5)))


def test_uneven_sampling_adds_the_slope_of_the_model_times_its_spread():
    """A PV that climbs by 3 a second, read 0.4 s too early or late: 1.2 beside a noise of 0.5 is 1.3."""
    climbing = 3.0 * T
    found = errors_of(np.zeros(N), np.zeros(N), spread_s=0.4, pv=climbing).by_part()
    assert {round(misfit.expected, 9) for misfit in found.values()} == {1.3}
    assert {misfit.noise for misfit in found.values()} == {0.5}


def test_a_long_record_has_five_blocks_of_its_own():
    sizes = np.repeat([1.0, 2.0, 3.0, 4.0, 5.0], N // 5)
    blocks = errors_of(2.0 * sizes, sizes).of_blocks()
    assert [block.after for block in blocks] == pytest.approx([1.0, 2.0, 3.0, 4.0, 5.0])
    assert [block.before for block in blocks] == pytest.approx([2.0, 4.0, 6.0, 8.0, 10.0])


@pytest.mark.parametrize(("count", "blocks"), [(499, 0), (500, 5)])
def test_a_short_record_has_none(count, blocks):
    found = errors_of(np.zeros(count), np.zeros(count), pv=COURSE[:count])
    assert len(found.of_blocks()) == blocks


def test_a_record_too_short_for_a_test_part_is_judged_by_its_selection():
    pv = COURSE[:24]
    found = errors_of(np.full(24, 2.0), np.ones(24), pv=pv).by_part()
    assert found["held_out"] == found["selection"]


def test_the_pictures_are_in_the_units_of_the_record():
    before, after = by_parts(4.0, 6.0, 8.0), by_parts(1.0, 2.0, 3.0)
    curves = errors_of(before, after).traces()
    assert np.allclose(curves.pv, COURSE)
    assert np.allclose(curves.pv - curves.before, before)
    assert np.allclose(curves.pv - curves.after, after)
    assert np.allclose(curves.output, 40.0 + np.repeat(np.resize([0.0, 5.0, -5.0], N // 50), 50))
    assert curves.held_out_from_s == 800.0


@given(st.floats(1e-2, 1e2), st.floats(-1e3, 1e3))
@settings(max_examples=10, deadline=None)
def test_errors_scale_with_the_units_of_the_pv(scale, offset):
    before, after = by_parts(4.0, 6.0, 8.0), by_parts(1.0, 2.0, 3.0)
    found = errors_of(scale * before, scale * after, scale * 0.5, 0.4, scale * COURSE + offset).by_part()
    for name, one in errors_of(before, after, 0.5, 0.4).by_part().items():
        for figure in ("before", "after", "noise", "expected"):
            assert getattr(found[name], figure) == pytest.approx(scale * getattr(one, figure), rel=1e-6)


# ------------------------------------------------------------------------------------------------------------ shares

LEVELS = np.random.default_rng(5).uniform(-8.0, 8.0, N)


def shares(residual, noise=0.0, scale=1.0, of_output=1.0):
    """The shares of a residual beside an output that changes at each sample; the PV is noise of its own."""
    pv = scale * (50.0 * WHITE[3] + residual)
    _, context = seen_of(pv, of_output * LEVELS)
    found = dependences(context, model_of(context, pv, scale * residual), scale * noise)
    return {d.variable: d for d in found}, found


def standard(values):
    return (values - values.mean()) / np.std(values)


@pytest.mark.parametrize("known", [0.25, 0.5, 0.9, 1.0])
@pytest.mark.parametrize(
    ("curve", "shape"), [(LEVELS, "in proportion"), (LEVELS**2, "like its square"), (LEVELS**3, None)]
)
def test_the_share_of_the_output_is_that_of_its_variance(curve, shape, known):
    """A part of the variance is a curve of the output, the rest depends on nothing."""
    residual = math.sqrt(known) * standard(curve) + math.sqrt(1.0 - known) * WHITE[0]
    found, ordered = shares(residual)
    assert found["output"].share == pytest.approx(known, abs=0.12)
    assert ordered[0].variable == "output"
    assert shape is None or found["output"].shape == shape
    assert found["time"].share < 0.15


@pytest.mark.parametrize("sigma", [0.5, 1.0])
def test_noise_is_no_part_of_what_is_missing(sigma):
    """All but the noise depends on the output: the share is 1, whatever the noise."""
    found, _ = shares(standard(LEVELS) + sigma * WHITE[0], noise=sigma)
    assert found["output"].share == pytest.approx(1.0, abs=0.12)


def test_a_share_is_of_what_noise_leaves():
    """Variances of 1 by the output, 1 by nothing known and 4 of noise: a half of what is missing, a sixth of all."""
    found, _ = shares(standard(LEVELS) + WHITE[0] + 2.0 * WHITE[1], noise=2.0)
    assert found["output"].share == pytest.approx(0.5, abs=0.15)


def test_a_residual_that_is_no_more_than_noise_has_no_shares():
    assert shares(WHITE[0], noise=1.2)[1] == ()


def test_what_depends_on_nothing_is_said_to():
    _, ordered = shares(WHITE[0])
    assert max(d.share for d in ordered) < 0.15
    assert "depends on none of" in in_words(ordered)[0]


def test_time_is_learned_on_every_second_tenth():
    found, ordered = shares(standard((T / N) ** 2))
    assert ordered[0].variable == "time"
    assert found["time"].share > 0.9


@pytest.mark.parametrize(("scale", "of_output"), [(1e-3, 1.0), (250.0, 0.01), (1.0, -40.0)])
def test_shares_are_the_same_in_other_units(scale, of_output):
    residual = standard(LEVELS**2) + WHITE[0]
    one, other = shares(residual)[0], shares(residual, scale=scale, of_output=of_output)[0]
    assert one["output"].shape == other["output"].shape == "like its square"
    for name, found in one.items():
        assert other[name].share == pytest.approx(found.share, abs=1e-6)


# ---------------------------------------------------------------------------------------------------------- evidence


def test_evidence_is_a_fall_of_squares():
    """White residuals of 3 and 1 beside a noise of 1; and of 2 and 1 where nothing was fitted."""
    pv = COURSE + 0.0 * WHITE[0]
    _, context = seen_of(pv)
    before, after = by_parts(3.0, 2.0, 0.0) * np.abs(WHITE[0]), WHITE[1]
    one, other = model_of(context, pv, before, size=3), model_of(context, pv, after, size=5)
    found = weigh(context, one, other)
    fitted, held = (np.mean(before[rows] ** 2) / np.mean(after[rows] ** 2) for rows in (context.fine, context.held_out))
    assert found.fall == pytest.approx(1.0 - 1.0 / fitted, rel=1e-4)
    assert found.held_out_ratio == pytest.approx(1.0 / held, rel=1e-3)
    assert found.share == pytest.approx(1.0, abs=0.02)
    # n ln(S1/S2) - 2 (ln n + ln 8/2): two numbers more, priced by samples and forms tried.
    n = context.fine.size
    assert found.gain == pytest.approx(n * math.log(fitted) - 2.0 * (math.log(n) + math.log(8.0) / 2.0), rel=1e-3)
    assert not found.quiet


def test_the_fall_elsewhere_is_in_its_standard_errors():
    """White noise: the mean of the differences of the squares over its standard error."""
    pv = COURSE
    _, context = seen_of(pv)
    before, after = 1.5 * WHITE[0], WHITE[1]
    ratio, z = held_out_gain(context, model_of(context, pv, before), model_of(context, pv, after))
    d = (before**2 - after**2)[context.held_out]
    assert z == pytest.approx(d.mean() / (np.std(d) / math.sqrt(d.size)), rel=0.02)
    assert z == pytest.approx(scipy.stats.ttest_1samp(d, 0.0).statistic, rel=0.02)
    assert ratio == pytest.approx(
        np.mean(after[context.held_out] ** 2) / np.mean(before[context.held_out] ** 2), rel=1e-3
    )


def test_of_processes_that_integrate_the_slopes_decide():
    """A wave of 20 samples on a random walk: hidden in the walk itself, three quarters of the squares of its steps."""
    pv = COURSE
    _, context = seen_of(pv)
    walk = 3.0 * np.cumsum(WHITE[0])
    wave = 3.0 * math.sqrt(6.0) / (math.pi / 10.0) * np.sin(np.pi / 10.0 * T)
    models = [[model_of(context, pv, r, s) for r in (walk + wave, walk)] for s in (FOPDT, INTEGRATING)]
    (ratio, z), (by_slopes, sure) = (held_out_gain(context, *pair) for pair in models)
    steps = [np.diff(r[context.held_out]) ** 2 for r in (walk + wave, walk)]
    assert by_slopes == pytest.approx(np.mean(steps[1]) / np.mean(steps[0]), rel=1e-2)
    assert by_slopes < 0.4 < ratio
    assert sure > 5.0 > z
    away = [model_of(context, pv, r, INTEGRATING) for r in (walk + wave, walk + 300.0)]
    assert held_out_gain(context, *away)[0] > 1.0


@pytest.mark.parametrize(("sizes", "expected"), [
    ((10.0, 9.0, 8.0), True),  # 17 of the 80 squares that both take away
    ((10.0, 2.0, 1.9), False),  # 0.4 of 96
    ((100.0, 3.0, 1.0), True),  # 8 of 9,999, but noise alone is left
    ((100.0, 1.6, 1.0), False),
])  # fmt: skip
def test_a_further_effect_has_its_weight_in_the_whole_fall_or_leaves_noise_alone(sizes, expected):
    _, context = seen_of(COURSE)
    assert weighs_enough(context, *(model_of(context, COURSE, size * WHITE[0]) for size in sizes)) is expected


@pytest.mark.parametrize(("effects", "before", "after", "expected"), [
    (2, 9.0, 8.0, True), (3, 9.0, 8.0, False), (3, 5.0, 2.0, True),
])  # fmt: skip
def test_a_third_effect_has_to_complete_the_explanation(effects, before, after, expected):
    _, context = seen_of(COURSE)
    alone, first, last = (model_of(context, COURSE, size * WHITE[0]) for size in (10.0, before, after))
    named = tuple(
        SimpleNamespace(measured=k == 0, reads_as=None, unseen_after=False) for k in range(effects + 1)
    )  # the first has a column
    last = replace(last, problem=replace(last.problem, effects=named))
    assert weighs_enough(context, alone, first, last) is expected


@pytest.mark.parametrize(("first", "second", "expected"), [
    (Place.DISTURBANCE, Place.ACTUATOR, True), (Place.ACTUATOR, Place.DISTURBANCE, False),
    (Place.DISTURBANCE, Place.SENSOR, False),
])  # fmt: skip
def test_what_the_output_does_is_no_correction_of_a_large_drift(first, second, expected):
    """Three of the 10,000 squares, to the noise: of a drift's form, or play beside it."""
    _, context = seen_of(COURSE)
    alone, before, after = (model_of(context, COURSE, size * WHITE[0]) for size in (100.0, 2.0, 1.0))
    effects = [
        SimpleNamespace(name=name, place=place, measured=False, reads_as=None, unseen_after=False)
        for name, place in (("first", first), ("second", second))
    ]
    before = replace(before, problem=replace(before.problem, effects=tuple(effects[:1])))
    after = replace(after, problem=replace(after.problem, effects=tuple(effects)))
    assert weighs_enough(context, alone, before, after) is expected


# ------------------------------------------------------------------------------------------------------- coincidence


def beside_a_free_load(context, *errors, size=3):
    model = model_of(context, COURSE, by_parts(*errors, 0.0), size=size)
    effects = tuple(
        SimpleNamespace(reads_as=reads_as, key="", rank=0, unseen_after=False) for reads_as in ("ambient", None)
    )
    return replace(model, problem=replace(model.problem, effects=effects))


def test_loads_of_free_shape_are_ranked_by_the_criterion_where_one_of_them_leads():
    """Their errors elsewhere are the loads': the closest one of all; where another leads, they stay behind."""
    _, context = seen_of(COURSE)
    far, close = beside_a_free_load(context, 1.0, 2.0), beside_a_free_load(context, 0.9, 2.1)
    plain, behind = model_of(context, COURSE, by_parts(1.1, 2.1, 0.0)), beside_a_free_load(context, 0.8, 2.5)
    assert best_on_both_parts(context, [plain, behind, far, close]) == [behind, close, far, plain]
    assert best_on_both_parts(context, [behind, plain]) == [plain, behind]


@pytest.mark.parametrize(("selected", "stays"), [(1.3, False), (1.5, True)])
def test_a_plainer_explanation_has_to_predict_the_other_part_too(monkeypatch, selected, stays):
    monkeypatch.setattr(simplify, "is_physical", lambda _: True)
    _, context = seen_of(COURSE)
    rich = model_of(context, COURSE, by_parts(1.0, 1.0, 0.0), size=4)
    plain = model_of(context, COURSE, by_parts(1.0, selected, 0.0))
    assert (simplify._plainer(context, rich, plain) is rich) is stays


def moved_at(*at, n=N):
    output = sum((5.0 * (T[:n] >= moment) for moment in at), np.full(n, 40.0))
    return dataset_of(Recording(T[:n], output, COURSE[:n]))


@pytest.mark.parametrize(("begins", "lasts", "expected"), [
    (112.0, None, True), (114.0, None, True), (114.1, None, False), (110.0, None, True), (109.9, None, False),
    (100.0, None, False),  # the move itself: its answer arrives 12 s later
    (300.0, 112.0, True),  # ends with the answer to the second move
    (300.0, 115.0, False), (412.0, 50.0, True), (math.inf, None, False),
])  # fmt: skip
def test_a_load_within_two_samples_of_an_answer_coincides(begins, lasts, expected):
    sizes = {"size": 3.0, "at_s": begins} | ({} if lasts is None else {"lasts_s": lasts})
    assert answers_a_move(sizes, moved_at(100.0, 400.0), 12.0) is expected


@pytest.mark.parametrize(("moves", "expected"), [(10, True), (11, False)])
def test_among_many_moves_chance_makes_it(moves, expected):
    assert answers_a_move({"at_s": 112.0}, moved_at(*(100.0 + 70.0 * np.arange(moves))), 12.0) is expected


@pytest.mark.parametrize(("count", "expected"), [(79, False), (85, True)])
def test_in_a_short_record_chance_makes_it(count, expected):
    """Two moves with two samples on each side are 8 s, a tenth of 80."""
    assert answers_a_move({"at_s": 22.0}, moved_at(10.0, 40.0, n=count), 12.0) is expected


def test_a_record_without_moves_has_no_answers():
    assert not answers_a_move({"at_s": 22.0}, moved_at(), 12.0)


# ---------------------------------------------------------------------------------------------------- sampling times

SLOPE = 0.3 * np.cos(T / 15.0) * (1.0 + np.sign(np.sin(T / 80.0)))


def likelihood(residual, variance):
    return float(np.sum(scipy.stats.norm.logpdf(residual, scale=np.sqrt(variance))))


@pytest.mark.parametrize(("sigma", "tau_s"), [(0.05, 0.3), (0.05, 0.8), (0.2, 0.8)])
def test_the_spread_of_the_times_is_the_likeliest(sigma, tau_s):
    """Against a search by scipy over the normal density; its steps are tenths of residual over slope."""
    residual = sigma * WHITE[0] + tau_s * SLOPE * WHITE[1]
    best = scipy.optimize.minimize_scalar(
        lambda tau: -likelihood(residual, sigma**2 + tau**2 * SLOPE**2), bounds=(0.01, 3.0), method="bounded"
    )
    found_s, gain = jitter_of(residual, SLOPE, sigma)
    step_s = 0.1 * float(np.sqrt(np.mean(residual**2) / np.mean(SLOPE**2)))
    assert found_s == pytest.approx(best.x, abs=0.51 * step_s)
    assert found_s == pytest.approx(tau_s, abs=step_s)
    whole = -best.fun - likelihood(residual, np.full(N, np.mean(residual**2)))
    assert 0.9 * whole < gain <= whole + 1e-6


def test_noise_without_jitter_gains_nothing():
    assert jitter_of(0.2 * WHITE[0], SLOPE, 0.2)[1] < 5.0


@pytest.mark.parametrize("of", [jitter_of, lambda residual, slope, _: unevenness_of(residual, slope)])
@pytest.mark.parametrize(("of_pv", "of_time"), [(1e3, 1.0), (1e-2, 1.0), (1.0, 60.0), (2.0, 1e-3)])
def test_sampling_times_do_not_depend_on_units(of, of_pv, of_time):
    """The spread is a time: the units of the PV fall out, and minutes are sixtieths of seconds."""
    residual = 0.05 * WHITE[0] + 0.5 * SLOPE * WHITE[1]
    one, gain = of(residual, SLOPE, 0.05)
    other, as_well = of(of_pv * residual, of_pv / of_time * SLOPE, of_pv * 0.05)
    assert other == pytest.approx(of_time * one)
    assert as_well == pytest.approx(gain)
