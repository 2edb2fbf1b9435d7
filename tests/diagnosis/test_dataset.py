"""A recording made ready: its noise, its beginning, the ends of its range, and parts that never meet."""

import math

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner import Recording
from autotuner.core.diagnosis.record.dataset import COLD, dataset_of, noise_at_rest, one_noise
from autotuner.core.diagnosis.record.parts import parts_of

RANDOM = np.random.default_rng(21)
WHITE = RANDOM.normal(0.0, 1.0, 3000)


def course(n):
    """A slow motion of the PV of some tens of units."""
    return 20.0 * np.sin(np.arange(n) / 200.0)


def record_of(pv, output=None, t=None, **told):
    n = len(pv)
    t = np.arange(float(n)) if t is None else t
    output = np.where(np.arange(n) >= n // 4, 45.0, 40.0) if output is None else output
    return Recording(t, output, np.asarray(pv, dtype=float), settings=told)


def coloured(phi, n=2000, seed=4):
    """Noise of the first order with a standard deviation of 1: x_k = phi x_k-1 + sqrt(1 - phi^2) e_k."""
    e = np.random.default_rng(seed).normal(0.0, 1.0, n + 500)
    return scipy.signal.lfilter([math.sqrt(1.0 - phi**2)], [1.0, -phi], e)[500:]


def of_second_differences(phi):
    """Closed form: var(x_k-1 - 2 x_k + x_k+1)/6 of such noise is (6 - 8 phi + 2 phi^2)/6."""
    return math.sqrt((6.0 - 8.0 * phi + 2.0 * phi**2) / 6.0)


# ------------------------------------------------------------------------------------------------------------- noise


@pytest.mark.parametrize("sigma", [0.01, 0.3, 2.0])
def test_white_noise_beside_a_motion_has_its_own_deviation(sigma):
    """The output moves at the first sample: nothing is at rest."""
    moved = np.append(40.0, np.full(2999, 45.0))
    assert dataset_of(record_of(course(3000) + sigma * WHITE, moved)).noise == pytest.approx(sigma, rel=0.05)


@pytest.mark.parametrize("phi", [0.5, 0.9])
def test_coloured_noise_is_measured_at_rest(phi):
    """Second differences see 0.27 of a noise with a memory of 10 samples; the deviation at rest all of it."""
    assert 1.0 / of_second_differences(phi) < 6.0
    assert dataset_of(record_of(0.2 * coloured(phi))).noise == pytest.approx(0.2, rel=0.15)


def test_what_wanders_at_rest_is_a_disturbance_and_counts_six_times_its_differences():
    phi = 0.999
    assert 1.0 / of_second_differences(phi) > 6.0
    expected = 6.0 * of_second_differences(phi)
    moved = np.where(np.arange(8000) >= 600, 45.0, 40.0)
    assert dataset_of(record_of(coloured(phi, 8000), moved)).noise == pytest.approx(expected, rel=0.05)


def test_coloured_noise_without_a_rest_is_seen_by_its_second_differences():
    moved = np.append(40.0, np.full(1999, 45.0))
    expected = of_second_differences(0.9)
    assert dataset_of(record_of(coloured(0.9), moved)).noise == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize(
    ("rest", "expected"), [(1.5, 1.5), (5.9, 5.9), (6.1, 6.0), (100.0, 6.0), (0.9, 1.0), (0.34, 1.0), (0.2, 0.6)]
)
def test_of_two_measures_of_noise_one_counts(rest, expected):
    """The larger, up to six times the other; a rest that is far quieter bounds it by three times its own."""
    assert one_noise(1.0, rest) == pytest.approx(expected)
    assert one_noise(7.0, 7.0 * rest) == pytest.approx(7.0 * expected)


@pytest.mark.parametrize("turns", [1.0, 3.3, 12.0])
def test_a_sine_at_rest_is_no_noise(turns):
    t = np.arange(300.0) / 300.0
    swinging = 0.5 * np.sin(2.0 * math.pi * turns * t) + 0.1 * WHITE[:300]
    assert noise_at_rest(0.1, swinging) == 0.1


def test_one_wave_in_much_noise_stays_noise():
    """A sine with a fifth of the squares is no oscillation."""
    swinging = 0.05 * np.sin(np.arange(300.0) / 8.0) + 0.1 * WHITE[:300]
    assert noise_at_rest(0.08, swinging) == pytest.approx(float(np.std(swinging, ddof=1)))


def test_a_drift_at_rest_is_no_noise():
    pv = 0.1 * WHITE
    pv[:750] += 0.01 * np.arange(750.0)
    assert dataset_of(record_of(pv)).noise == pytest.approx(0.1, rel=0.1)


def test_spikes_that_are_left_out_make_no_noise():
    pv, out = course(3000) + 0.1 * WHITE, np.zeros(3000, dtype=bool)
    out[::5] = True
    pv[out] += 1000.0 * np.sign(WHITE[out])
    found = dataset_of(record_of(pv), out)
    assert found.noise < 0.3
    assert not (found.fitted & out).any()
    assert not (found.held_out & out).any()
    assert found.data.weight.tolist() == (~out).astype(float).tolist()


@given(st.floats(1e-2, 1e2), st.floats(-1e3, 1e3))
@settings(max_examples=25, deadline=None)
def test_a_record_in_other_units_scales(scale, offset):
    """A PV in other units: noise and floor scale, parts and rest stay."""
    one = dataset_of(record_of(course(600) + 0.1 * WHITE[:600]))
    other = dataset_of(record_of(scale * (course(600) + 0.1 * WHITE[:600]) + offset))
    for name in ("noise", "floor"):
        assert getattr(other, name) == pytest.approx(scale * getattr(one, name), rel=1e-6)
    assert other.pv0 == pytest.approx(scale * one.pv0 + offset, rel=1e-6, abs=1e-6 * scale)
    assert np.allclose(other.data.pv, scale * one.data.pv, atol=1e-9 * (1.0 + abs(offset)))
    for name in ("fitted", "held_out", "spikes"):
        assert np.array_equal(getattr(other, name), getattr(one, name))
    assert (other.at_rest, other.swing, other.settled_first) == (one.at_rest, one.swing, one.settled_first)


# ------------------------------------------------------------------------------------------------- beginning and loop


def test_a_record_is_about_its_median_and_its_first_output():
    found = dataset_of(record_of(course(401) + 70.0))
    assert found.pv0 == pytest.approx(float(np.median(course(401))) + 70.0)
    assert np.median(found.data.pv) == 0.0
    assert (found.output0, found.swing, found.at_rest, found.span_s) == (40.0, 5.0, 100, 400.0)
    assert found.floor == pytest.approx(1e-3 * float(np.std(course(401))))


def test_a_record_that_begins_cold_steps_from_zero():
    plain, cold = (dataset_of(record_of(course(400)), begins=begins) for begins in ("", COLD))
    assert (plain.output0, cold.output0) == (40.0, 0.0)
    assert (cold.data.held.levels - plain.data.held.levels).tolist() == [40.0, 40.0]
    assert cold.settled_first


@pytest.mark.parametrize(("rest", "moves", "expected"), [
    (100, 0.0, True), (100, 0.1, True), (100, 5.0, False), (9, 0.0, False)
])  # fmt: skip
def test_a_record_begins_at_rest_where_ten_samples_stand_still(rest, moves, expected):
    n = 400
    output = np.where(np.arange(n) >= rest, 50.0, 40.0)
    pv = np.where(np.arange(n) >= rest, 30.0, moves * np.arange(n) / rest)
    assert dataset_of(record_of(pv, output)).settled_first is expected


def test_noise_at_rest_is_a_rest():
    """Noise of a third of the motion: its deviation is that of its second differences."""
    n = 400
    pv = np.where(np.arange(n) >= 200, 3.0, 0.0) + WHITE[:n]
    assert dataset_of(record_of(pv, np.where(np.arange(n) >= 200, 50.0, 40.0))).settled_first


@pytest.mark.parametrize(("changes", "expected"), [(119, False), (125, True)])
def test_a_controller_moves_the_output_at_three_samples_in_ten(changes, expected):
    output = 40.0 + 1e-3 * np.minimum(np.arange(400), changes)
    assert dataset_of(record_of(course(400), output)).in_loop is expected


def test_the_experiment_of_a_tuning_is_no_closed_loop():
    told = record_of(course(400), 40.0 + WHITE[:400], segments={"relay": 10.0, "tail": 300.0})
    found = dataset_of(told)
    assert (found.tuned, found.in_loop, found.settled_first) == (True, False, True)


def test_restarts_count_from_the_beginning():
    t = 1000.0 + np.arange(400.0)
    assert dataset_of(record_of(course(400), t=t, restarts_s=[1100.0, 1250.5])).restarts_s == (0.0, 100.0, 250.5)


# ------------------------------------------------------------------------------------------------------ ends of range


def test_a_pv_that_rests_at_an_end_of_its_range_is_there_or_beyond():
    pv = np.clip(20.0 * np.sin(np.arange(800) / 40.0) + 0.01 * WHITE[:800], -15.0, 18.0)
    found = dataset_of(record_of(pv))
    assert (found.bottom + found.pv0, found.top + found.pv0) == pytest.approx((-15.0, 18.0))
    inside = (pv > -15.0) & (pv < 18.0)
    assert np.array_equal(found.fitted, inside & (found.data.t <= 0.75 * 799.0))


@pytest.mark.parametrize("pv", [
    course(800) + 0.01 * WHITE[:800],  # one sample at each end
    np.round(20.0 * np.sin(np.arange(800) / 40.0)),  # a coarse sensor rests at every value
], ids=["free", "coarse"])  # fmt: skip
def test_a_pv_that_only_turns_has_no_end(pv):
    found = dataset_of(record_of(pv))
    assert (found.bottom, found.top) == (-math.inf, math.inf)


@pytest.mark.parametrize(("together", "ends"), [(5, True), (1, False)])
def test_an_end_is_where_the_pv_stays_in_a_row(together, ends):
    """Twelve samples in all, in a row or one by one."""
    pv = course(1200) + 0.01 * WHITE[:1200]
    at = 300 + np.concatenate([np.arange(together) + 40 * k for k in range(12 // together + 1)])
    pv[at] = 25.0
    assert math.isfinite(dataset_of(record_of(pv)).top) is ends


# ------------------------------------------------------------------------------------------------------------- parts


@st.composite
def records(draw):
    """Records of uneven times, some of them with a tail."""
    n = draw(st.integers(30, 300))
    t = np.cumsum(np.random.default_rng(draw(st.integers(0, 99))).uniform(0.1, 3.0, n)) + draw(st.floats(-1e3, 1e3))
    tail = draw(st.none() | st.floats(0.3, 0.9))
    told = {} if tail is None else {"segments": {"relay": t[0], "tail": float(t[0] + tail * (t[-1] - t[0]))}}
    return Recording(t, 40.0 + np.sin(np.arange(n)), course(n) + WHITE[:n], settings=told)


@given(records())
@settings(max_examples=50, deadline=None)
def test_fit_selection_and_test_never_meet_and_leave_nothing_out(record):
    parts = parts_of(record)
    seen = dataset_of(parts.before_test)
    count = len(record)
    tested = np.zeros(count, dtype=int)
    tested[parts.tested] = 1
    fitted, selected = (np.append(part, np.zeros(count - part.size)) for part in (seen.fitted, seen.held_out))
    assert (fitted + selected + tested).tolist() == [1] * count
    last_fitted, first_selected = np.flatnonzero(fitted).max(), np.flatnonzero(selected).min()
    assert last_fitted < first_selected
    assert parts.tested.stop == count
    assert np.flatnonzero(selected).max() < parts.tested.start


@given(records())
@settings(max_examples=50, deadline=None)
def test_the_test_part_is_a_share_of_the_record_or_three_tenths_of_the_tail(record):
    parts, t = parts_of(record), record.t
    from_s = record.segments.get("tail", t[0])
    shares = (0.3,) if record.segments else (0.2, 0.15, 0.1)
    possible = [np.flatnonzero(t > t[-1] - share * (t[-1] - from_s)).tolist() for share in shares]
    if 5 <= len(possible[0]) <= t.size - 20:
        assert list(range(parts.tested.start, parts.tested.stop)) in possible
        assert parts.test_from_s == pytest.approx(t[parts.tested.start] - t[0])
    else:
        assert parts.tested.start == parts.tested.stop == t.size
        assert parts.before_test is parts.whole


def staying(*levels):
    """Return a record whose output stays as long at each level."""
    output = np.repeat(np.array(levels, dtype=np.float64), 20)
    return Recording(np.arange(output.size, dtype=np.float64), output, course(output.size))


SWINGS = (40.0, 50.0) * 15  # three fifths of fifty stays of 20 samples
SEEN = (*SWINGS, *(40.0, 50.0) * 5)  # four fifths


@pytest.mark.parametrize(("levels", "share"), [
    pytest.param((*SEEN, *(40.0, 50.0) * 5), 0.2, id="nowhere new"),
    pytest.param((*SEEN, *(40.0, 49.0) * 5), 0.2, id="within"),
    pytest.param((*SEEN, *[60.0] * 2, *(40.0, 50.0) * 4), 0.15, id="new at first"),
    pytest.param((*SEEN, *(40.0, 50.0) * 2, *[60.0] * 6), 0.1, id="new at last"),
    pytest.param((*SEEN, *[50.0] * 10), 0.1, id="longer at a known level"),
])  # fmt: skip
def test_the_test_part_is_smaller_where_the_output_goes_where_it_was_not(levels, share):
    record = staying(*levels)
    assert parts_of(record).test_from_s == pytest.approx((1.0 - share) * record.t[-1], abs=1.0)
    other = Recording(record.t, record.output, np.random.default_rng(1).normal(50.0, 9.0, record.t.size))
    assert parts_of(other).tested == parts_of(record).tested, "the PV has no say in it"


def test_a_part_of_few_samples_is_not_made_smaller():
    """A tenth of 150 samples is too few for a test: 15 % of them are not."""
    t = np.arange(150.0)
    record = Recording(t, np.where(t < 120.0, 40.0 + 10.0 * (t // 10 % 2), 60.0), course(150))
    assert len(record) - len(parts_of(record).before_test) == 23


@pytest.mark.parametrize(("count", "tested"), [(25, 5), (24, 0), (26, 5), (100, 20)])
def test_a_record_too_short_for_three_parts_has_no_test_part(count, tested):
    """Five samples are tested at least, and twenty seen."""
    parts = parts_of(record_of(course(count)))
    assert len(parts.whole) - len(parts.before_test) == tested


@pytest.mark.parametrize("tail", [math.nan, "late", -5.0, 1e9])
def test_a_tail_outside_of_the_record_is_none(tail):
    record = record_of(course(400), segments={"tail": tail})
    assert len(parts_of(record).before_test) == len(parts_of(record_of(course(400))).before_test)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_share_of_the_tail_may_be_fitted_from_its_beginning(share):
    record = record_of(course(401), segments={"relay": 100.0, "tail": 300.0})
    found = dataset_of(record, tail_share=share)
    assert found.fitted_until_s == 300.0 + 100.0 * share
    assert np.count_nonzero(found.held_out) == 100 - round(100.0 * share)


def test_without_a_tail_three_quarters_are_fitted():
    """Of what is seen, which is four fifths: six tenths of the record, and two to select."""
    assert dataset_of(record_of(course(401))).fitted_until_s == 300.0


def test_the_whole_is_about_the_values_of_the_part_that_was_searched():
    record = record_of(course(500) + 70.0)
    parts = parts_of(record)
    seen = dataset_of(parts.before_test)
    whole = parts.whole_case(seen)
    assert np.array_equal(whole.data.pv[: len(parts.before_test)], seen.data.pv)
    assert np.allclose(whole.data.pv + seen.pv0, record.pv)
    assert whole.span_s == seen.span_s < whole.data.span_s
