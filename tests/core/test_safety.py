"""The supervisor: what it permits, and what each of its watches trips on, with hand-made samples."""

import math
from itertools import pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from autotuner.core.experiment.settings import Limits
from autotuner.core.recording import Sample
from autotuner.core.safety.supervisor import DRIVEN_BY_OTHERS, SafetySettings, Supervisor
from autotuner.core.verdict import Outcome
from autotuner.errors import InputError

GENEROUS = SafetySettings(pv_timeout_s=10.0, max_lateness_s=1.0)
ANY = st.floats(allow_nan=True, allow_infinity=True)


def supervisor(pv=(-math.inf, math.inf), **settings):
    return Supervisor(Limits(pv=pv), SafetySettings(**({"pv_timeout_s": 10.0, "max_lateness_s": 1.0} | settings)))


def codes(watched, samples, **keys):
    """The code of the verdict on each sample, None where there is none."""
    verdicts = [watched.check(sample, **keys) for sample in samples]
    assert all(v is None or (v.outcome is Outcome.ABORTED and v.remedy) for v in verdicts)
    return [v and v.code for v in verdicts]


def steady(count, pv=80.0, output=40.0, **keys):
    return [Sample(float(k), pv, output, **keys) for k in range(count)]


@given(
    wanted=st.lists(st.tuples(ANY, st.floats(0.0, 100.0)), min_size=1, max_size=40),
    start=st.floats(-20.0, 80.0),
    slew=st.one_of(st.just(math.inf), st.floats(1e-3, 1e3)),
)
@example(wanted=[(math.nan, 1.0), (math.inf, 1.0), (-math.inf, 0.0)], start=0.0, slew=5.0)
def test_no_sequence_of_wishes_leaves_the_limits_or_the_slew(wanted, start, slew):
    watched = Supervisor(Limits(output=(-20.0, 80.0), output_slew_per_s=slew), GENEROUS)
    held = start
    for spec, dt in wanted:
        now = watched.permit(spec, held, dt)
        assert -20.0 <= now <= 80.0
        assert math.isinf(slew) or abs(now - held) <= slew * dt * (1.0 + 1e-12) + 1e-12
        held = now


@given(spec=st.floats(-20.0, 80.0), held=st.floats(-20.0, 80.0))
def test_a_wish_within_limits_and_slew_is_granted(spec, held):
    watched = Supervisor(Limits(output=(-20.0, 80.0), output_slew_per_s=50.0), GENEROUS)
    assert watched.permit(spec, held, 2.0) == spec


@given(spec=st.floats(-1e6, 1e6), held=st.floats(0.0, 100.0))
def test_repeating_a_wish_reaches_the_nearest_permitted_output(spec, held):
    watched = Supervisor(Limits(output=(0.0, 100.0), output_slew_per_s=7.0), GENEROUS)
    for _ in range(15):
        held = watched.permit(spec, held, 1.0)
    assert held == min(max(spec, 0.0), 100.0)


def test_a_steady_loop_is_left_alone():
    samples = steady(500, set_point=80.0, lateness_s=0.9)
    assert set(codes(supervisor((0.0, 100.0)), samples, auto=0.0, phase="quiet")) == {None}


@pytest.mark.parametrize(("pv", "code"), [(100.1, "pv_limit"), (-0.1, "pv_limit"), (100.0, None), (0.0, None)])
def test_the_limits_of_the_pv(pv, code):
    assert codes(supervisor((0.0, 100.0)), steady(1, pv)) == [code]


def test_a_trip_names_limit_value_and_time():
    verdict = supervisor((0.0, 100.0)).check(Sample(12.5, 103.25, 40.0))
    assert "103.25" in verdict.message
    assert "0 to 100" in verdict.message
    assert "12.500 s" in verdict.message


def test_no_usable_pv_is_tolerated_for_a_while():
    watched = supervisor()
    assert codes(watched, [Sample(0.0, 80.0, 40.0)]) == [None]
    assert codes(watched, [Sample(t, math.nan, 40.0) for t in (5.0, 10.0)]) == [None, None]
    assert watched.check_blindness(10.1, usable=False).code == "pv_lost"


def test_infinity_is_no_pv():
    assert codes(supervisor(), [Sample(0.0, 80.0, 40.0), Sample(11.0, math.inf, 40.0)]) == [None, "pv_lost"]


def test_failed_reads_and_useless_values_count_together():
    watched = supervisor()
    watched.check(Sample(0.0, 80.0, 40.0))
    assert watched.check_blindness(6.0, usable=False) is None
    assert watched.check(Sample(10.5, math.nan, 40.0)).code == "pv_lost"


def test_a_gap_that_was_too_long_trips_even_when_the_pv_is_back():
    assert codes(supervisor(), [Sample(0.0, 80.0, 40.0), Sample(30.0, 80.0, 40.0)]) == [None, "pv_lost"]


def test_a_useful_value_starts_the_wait_anew():
    assert set(codes(supervisor(), [Sample(9.0 * k, 80.0, 40.0) for k in range(20)])) == {None}


def test_a_late_sample():
    samples = [Sample(0.0, 80.0, 40.0, lateness_s=1.0), Sample(1.0, 80.0, 40.0, lateness_s=1.01)]
    assert codes(supervisor(), samples) == [None, "sample_late"]


def mode_codes(autos, times):
    watched = supervisor()
    samples = [Sample(t, 80.0, 40.0) for t in times]
    return [code for s, a in zip(samples, autos, strict=True) for code in codes(watched, [s], auto=a)]


def test_the_device_may_take_its_time_to_follow_into_manual_and_must_stay_there():
    assert mode_codes([1.0, 1.0, 0.0, 0.0, 1.0, 1.0], range(6)) == [None] * 5 + ["mode_changed"]


def test_a_device_that_never_follows_into_manual():
    assert mode_codes([1.0, 1.0, 1.0], [0.0, 10.0, 10.5]) == [None, None, "mode_refused"]
    assert {"mode_changed", "mode_refused"} == DRIVEN_BY_OTHERS


def test_a_device_without_a_mode():
    assert mode_codes([None] * 3, range(3)) == [None] * 3


def test_somebody_changes_the_set_point():
    samples = [Sample(float(k), 80.0 + 0.1 * (k % 2), 40.0, 85.0 if k < 7 else 90.0) for k in range(9)]
    assert codes(supervisor(), samples) == [None] * 8 + ["set_point_changed"]


def test_a_set_point_that_follows_the_pv_in_manual_is_nobodys():
    """Many controllers do that, so that going to auto does not bump; theirs is the PV of a scan ago."""
    rising = [Sample(float(k), 80.0 + 0.3 * k, 40.0, 80.0 + 0.3 * (k - 1)) for k in range(60)]
    assert set(codes(supervisor(), rising)) == {None}


def test_a_set_point_that_stayed_behind_is_somebodys_even_when_it_meets_the_pv():
    """The PV swings by 10 about a fixed set point; then somebody sets just what the PV happens to be."""
    pvs = [80.0 + 10.0 * math.sin(0.1 * k) for k in range(90)]
    samples = [Sample(float(k), pv, 40.0, 80.0 if k < 75 else pvs[75]) for k, pv in enumerate(pvs)]
    assert codes(supervisor(), samples).index("set_point_changed") == 76


def test_a_coarse_set_point_that_follows_the_pv_in_steps_is_nobodys():
    pvs = [80.0 + 10.0 * math.sin(0.1 * k) for k in range(300)]
    samples = [Sample(float(k), pv, 40.0, float(round(pvs[max(k - 2, 0)]))) for k, pv in enumerate(pvs)]
    assert set(codes(supervisor(), samples)) == {None}


def test_a_set_point_in_single_precision_has_not_changed():
    samples = [Sample(0.0, 80.0, 40.0, 85.1), Sample(1.0, 80.0, 40.0, 85.0999984741211)]
    assert codes(supervisor(), samples) == [None, None]


def test_a_set_point_that_is_missing_for_a_moment_has_not_changed():
    samples = [Sample(0.0, 80.0, 40.0, 85.0), Sample(1.0, 80.0, 40.0), Sample(2.0, 80.0, 40.0, 85.0)]
    assert codes(supervisor(), samples) == [None, None, None]


def test_travel_is_the_sum_of_all_moves():
    """40 -> 50 -> 40 -> 50 travels 30."""
    outputs = [40.0, 50.0, 50.0, 40.0, 50.0]
    samples = [Sample(float(k), 80.0, u) for k, u in enumerate(outputs)]
    assert codes(supervisor(travel=29.9), samples) == [None] * 4 + ["travel_limit"]
    assert set(codes(supervisor(travel=30.0), samples)) == {None}


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_energy_is_the_integral_beyond_the_start(sign):
    """10 above the start for 3 s is 30; time back at the start adds nothing."""
    outputs = [40.0] + [40.0 + 10.0 * sign] * 3 + [40.0] * 50
    samples = [Sample(float(k), 80.0, u) for k, u in enumerate(outputs)]
    assert codes(supervisor(energy=29.9), samples)[:4] == [None, None, None, "energy_limit"]
    assert set(codes(supervisor(energy=30.0), samples)) == {None}


@given(outputs=st.lists(st.floats(0.0, 100.0), min_size=2, max_size=30), limit=st.floats(0.1, 500.0))
def test_a_budget_trips_with_the_first_sample_beyond_it(outputs, limit):
    tripped = [code == "travel_limit" for code in codes(supervisor(travel=limit), budget_samples(outputs))]
    moves = [abs(b - a) for a, b in pairwise(outputs)]
    spent = [math.fsum(moves[:k]) for k in range(len(outputs))]
    near = [abs(value - limit) < 1e-9 for value in spent]
    assert all(t == (value > limit) or close for t, value, close in zip(tripped, spent, near, strict=True))


def budget_samples(outputs):
    return [Sample(float(k), 80.0, u) for k, u in enumerate(outputs)]


def test_time_in_all_and_in_a_phase():
    assert codes(supervisor(time_limit_s=2.0), steady(4)) == [None, None, None, "time_limit"]
    watched = supervisor(phase_limit_s=2.0)
    phases = ["quiet"] * 3 + ["relay"] * 4
    samples = [(s, phase) for s, phase in zip(steady(7), phases, strict=True)]
    assert [code for s, phase in samples for code in codes(watched, [s], phase=phase)] == [None] * 6 + [
        "phase_time_limit"
    ]


@pytest.mark.parametrize(
    "field", ["pv_timeout_s", "max_lateness_s", "frozen_samples", "travel", "energy", "time_limit_s"]
)
def test_a_budget_must_be_positive(field):
    with pytest.raises(InputError, match=f"safety.{field}"):
        supervisor(**{field: 0})


def test_the_takeover_by_a_person_counts_more_than_any_limit():
    """Nothing is written after it, so it must not hide behind another trip of the same sample."""
    watched = supervisor((0.0, 100.0))
    watched.check(Sample(0.0, 80.0, 40.0), auto=0.0)
    assert watched.check(Sample(1.0, 80.0, 40.0), auto=1.0) is None
    assert watched.doubt
    assert watched.check(Sample(2.0, 300.0, 40.0, lateness_s=5.0), auto=1.0).code == "mode_changed"


def test_a_limit_that_is_passed_while_the_mode_is_in_doubt_counts_at_once():
    """The doubt stands beside it: whoever gives the output back then looks at the device before writing."""
    watched = supervisor((0.0, 100.0))
    watched.check(Sample(0.0, 80.0, 40.0), auto=0.0)
    assert watched.check(Sample(1.0, 300.0, 40.0), auto=1.0).code == "pv_limit"
    assert watched.doubt


AT = 7
"""Reading that is damaged."""


@pytest.mark.parametrize("damaged", [math.nan, 0.0, -85.0, 85.0 + 2.0**-4, 1e30, math.inf])
def test_one_damaged_reading_of_the_set_point_ends_nothing(damaged):
    watched = supervisor()
    samples = [Sample(float(k), 80.0 + 0.1 * (k % 2), 40.0, damaged if k == AT else 85.0) for k in range(40)]
    doubts = []
    for sample in samples:
        assert watched.check(sample) is None
        doubts.append(bool(watched.doubt))
    told = math.isfinite(damaged)  # one that is no number says itself that it is none
    assert doubts == [told and k == AT for k in range(40)]
    assert [f"{damaged:g}" in text and "7.000 s" in text for text in watched.damaged] == [True] * told


@pytest.mark.parametrize("damaged", [1.0, math.nan])
def test_one_damaged_reading_of_the_mode_ends_nothing(damaged):
    watched = supervisor()
    for sample in steady(40):
        assert watched.check(sample, auto=damaged if sample.t == AT else 0.0) is None
        assert bool(watched.doubt) == (sample.t == AT)
    assert len(watched.damaged) == 1


def test_a_mode_that_is_no_number_any_more_is_nobodys():
    """Nobody is known to have taken the loop over, so the output is given back."""
    codes_seen = mode_codes([0.0, 0.0, math.nan, math.nan], range(4))
    assert codes_seen == [None, None, None, "mode_unknown"]
    assert "mode_unknown" not in DRIVEN_BY_OTHERS


def test_a_set_point_that_goes_on_to_move_is_somebodys():
    """85, then 86, then 87: the second reading does not repeat the first, but it is not the old one either."""
    samples = [Sample(float(k), 80.0 + 0.1 * (k % 2), 40.0, 85.0 + max(k - 6, 0)) for k in range(9)]
    assert codes(supervisor(), samples) == [None] * 8 + ["set_point_changed"]


@pytest.mark.parametrize(("apart", "ends"), [(2, True), (15, True), (30, False)])
def test_two_damaged_readings_near_each_other_are_no_accident(apart, ends):
    samples = [Sample(float(k), 80.0 + 0.1 * (k % 2), 40.0, 90.0 if k in {10, 10 + apart} else 85.0) for k in range(60)]
    found = codes(supervisor(), samples)
    assert found[: 10 + apart] == [None] * (10 + apart)
    assert (found[10 + apart] == "set_point_changed") is ends


@pytest.mark.parametrize("at", [0, 1])
def test_a_damaged_reading_before_the_set_point_is_known(at):
    samples = [Sample(float(k), 80.0 + 0.1 * (k % 2), 40.0, 0.0 if k == at else 85.0) for k in range(30)]
    assert set(codes(supervisor(), samples)) == {None}
    samples += [Sample(30.0 + k, 80.0, 40.0, 90.0) for k in range(2)]
    assert codes(supervisor(), samples)[-1] == "set_point_changed"
