"""The robust design: its limits hold, nothing near it is better, and it scales as physics does."""

import csv
import functools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from autotuner.core.design import (
    Controller,
    NoiseLimit,
    PidGains,
    Purpose,
    Requirements,
    apply_rule,
    controller_response,
    design,
    is_stable,
    margins,
)
from autotuner.core.design.optimisation.loop_grid import loop_grid
from autotuner.core.model.process import (
    Fopdt,
    Integrating,
    InverseResponse,
    SopdtOverdamped,
    SopdtUnderdamped,
    UnstableFopdt,
    frequency_response,
)
from autotuner.errors import InputError

OPTIMA = Path(__file__).parents[2] / "benchmarks" / "baselines" / "data" / "optimum.csv"
PROCESSES = {
    "P1 T=0.3": Fopdt(1.0, 0.3, 1.0),
    "P1 T=1": Fopdt(1.0, 1.0, 1.0),
    "P1 T=10": Fopdt(1.0, 10.0, 1.0),
    "P1 T=1000": Fopdt(1.0, 1000.0, 1.0),
    "P2 T=1": SopdtOverdamped(1.0, 1.0, 1.0, 1.0),
    "P2 T=100": SopdtOverdamped(1.0, 100.0, 100.0, 1.0),
    "P6 L=0.1": Integrating(1.0, 0.9, 0.1),
    "P6 L=1": Integrating(1.0, 0.0, 1.0),
    "P7 T=5 L=0.3": SopdtOverdamped(5.0, 5.0, 0.7, 0.3),
}
OTHERS = [SopdtUnderdamped(1.0, 1.0, 0.5, 1.0), InverseResponse(1.0, 3.0, 1.0, 1.0, 0.3), Fopdt(-3.0, 4.0, 2.0)]
designed = functools.cache(design)
"""The same gains, computed once: several tests judge them."""


@pytest.fixture(scope="module")
def optima():
    if not OPTIMA.exists():
        pytest.skip("benchmarks/baselines/data/optimum.csv is not part of this checkout")
    with OPTIMA.open() as file:
        return {(row["process"], row["controller"]): row for row in csv.DictReader(file)}


@pytest.mark.one_of(4)
@pytest.mark.parametrize("name", PROCESSES)
@pytest.mark.parametrize("kind", ["ideal", "filtered"])
def test_the_error_is_that_of_an_optimum_found_by_other_code(optima, name, kind):
    found = (
        designed(PROCESSES[name], Requirements(filter_ratio=math.inf)) if kind == "ideal" else designed(PROCESSES[name])
    )
    assert found.iae == pytest.approx(float(optima[name, kind]["IAE"]), rel=0.012)


@settings(max_examples=6, deadline=None)
@given(st.data())
def test_limits_hold_for_any_process(stable_models, data):
    model = data.draw(stable_models)
    M = data.draw(st.sampled_from([1.2, 1.4, 1.7, 2.0]))
    found = design(model, Requirements(Ms=M, Mt=M))
    assert found.margins.stable
    assert found.margins.Ms <= M * 1.001
    assert found.margins.Mt <= M * 1.001
    assert found.warnings == ()


def test_a_peak_between_two_frequencies_of_the_grid_keeps_the_limit():
    """Of a process that rings, beside a dead time: the sensitivity has a peak that is narrower than the grid."""
    model = SopdtUnderdamped(1.0, 10.75**2, 2.0 * 0.95 * 0.125 * 10.75, 9.0)
    gains = design(model, Requirements(Ms=2.0, Mt=2.0)).gains
    jw = 1j * np.linspace(0.1, 0.12, 200_001)
    measured = 1.0 / (1.0 + gains.Tf * jw * (1.0 + gains.Tf * jw / 2.0))
    controller = gains.Kp * (1.0 + 1.0 / (gains.Ti * jw) + gains.Td * jw) * measured
    process = model.K * np.exp(-model.D * jw) / (model.m * jw**2 + model.n * jw + 1.0)
    assert np.max(1.0 / np.abs(1.0 + controller * process)) <= 2.0


@pytest.mark.one_of(3)
@pytest.mark.parametrize("model", [*PROCESSES.values(), *OTHERS], ids=str)
def test_no_controller_near_it_is_better_inside_the_limits(model):
    found = designed(model)
    grid = loop_grid(model)
    rng = np.random.default_rng(1)
    for scale in (0.02, 0.1, 0.3):
        for _ in range(20):
            kp, ti, td, tf = np.exp(scale * rng.standard_normal(4))
            g = found.gains
            other = PidGains(g.Kp * kp, g.Ti * ti, g.Td * td, max(g.Tf * tf, g.Td * td / 10.0))
            robust = margins(model, other)
            if robust.stable and robust.Ms <= 1.4 and robust.Mt <= 1.4:
                assert grid.integral_of(grid.load_error(other)) >= found.iae * 0.99


@pytest.mark.parametrize("model", [*PROCESSES.values(), *OTHERS], ids=str)
def test_it_beats_every_rule_that_is_as_robust(model):
    found = designed(model)
    grid = loop_grid(model)
    for rule in ("simc_pi", "simc_pid", "amigo_pi", "amigo_pid", "tyreus_luyben_pi", "lambda_pi"):
        try:
            gains = apply_rule(rule, model).gains
        except InputError:
            continue
        robust = margins(model, gains)
        if robust.stable and robust.Ms <= 1.4 and robust.Mt <= 1.4:
            assert found.iae <= 1.01 * grid.integral_of(grid.load_error(gains))


@settings(max_examples=4, deadline=None)
@given(st.floats(1e-3, 1e3), st.floats(0.01, 100.0), st.sampled_from([*PROCESSES.values()][:5]))
def test_it_scales_with_the_units_of_time_and_gain(time, gain, model):
    plain = designed(model).gains
    values = {name: value * (gain if name == "K" else time) for name, value in model.parameters().items()}
    scaled = design(type(model)(**values)).gains
    assert scaled.Kp * gain == pytest.approx(plain.Kp, rel=0.02)
    assert (scaled.Ti / time, scaled.Td / time) == pytest.approx((plain.Ti, plain.Td), rel=0.05)


def test_it_is_deterministic():
    model = SopdtOverdamped(2.0, 10.0, 3.0, 1.5)
    assert design(model).gains == design(model).gains


def test_sign_of_the_process_turns_the_sign_of_the_gain():
    assert design(Fopdt(-2.0, 10.0, 1.0)).gains.Kp == -designed(Fopdt(2.0, 10.0, 1.0)).gains.Kp


@pytest.mark.parametrize("kind", list(Controller))
def test_only_the_parts_allowed_are_used(kind):
    found = design(Fopdt(1.0, 10.0, 1.0), Requirements(controller=kind))
    assert found.gains.controller == kind.value
    assert math.isfinite(found.iae) == (kind is not Controller.P)


def test_proportional_gain_by_hand():
    # An integrator with dead time 1 under P control has its largest Ms = 1.4 at a gain that bisection also finds.
    model = Integrating(1.0, 0.0, 1.0)
    low, high = 0.0, 1.5
    w = np.linspace(1e-3, 30.0, 300_001)
    for _ in range(50):
        k = (low + high) / 2.0
        S = 1.0 / np.abs(1.0 + k * frequency_response(model, w))
        low, high = (k, high) if np.max(S) <= 1.4 else (low, k)
    assert design(model, Requirements(controller=Controller.P)).gains.Kp == pytest.approx(low, rel=2e-3)


def test_derivative_ratio_is_kept_for_devices_of_the_series_form():
    gains = design(SopdtUnderdamped(1.0, 1.0, 0.5, 1.0), Requirements(derivative_ratio=0.25)).gains
    assert gains.Td <= 0.25 * gains.Ti


@settings(max_examples=4, deadline=None)
@given(st.floats(0.02, 2.0), st.sampled_from([Fopdt(1.0, 10.0, 1.0), SopdtOverdamped(2.0, 10.0, 3.0, 1.0), OTHERS[0]]))
def test_jitter_of_the_output_is_kept(jitter, model):
    noise = NoiseLimit(sigma=0.1, jitter=jitter, sample_time_s=0.1)
    gains = design(model, Requirements(noise=noise)).gains
    w = np.linspace(1e-5, math.pi / noise.sample_time_s, 400_001)
    C = controller_response(gains, w)
    R = C / (1.0 + C * frequency_response(model, w))
    variance = noise.sigma**2 * noise.sample_time_s / math.pi * np.trapezoid(np.abs(R) ** 2, w)
    assert math.sqrt(variance) <= jitter * 1.02


def test_no_jitter_at_all_is_refused():
    with pytest.raises(InputError, match="allows no PID"):
        design(Fopdt(2.0, 10.0, 1.5), Requirements(noise=NoiseLimit(0.1, 1e-200, 0.1)))


@pytest.mark.long  # the jitter that is kept is in the tests beside it
def test_less_jitter_costs_error():
    model = SopdtOverdamped(2.0, 10.0, 3.0, 1.0)
    errors = [design(model, Requirements(noise=NoiseLimit(0.1, jitter, 0.1))).iae for jitter in (2.0, 0.2, 0.03)]
    assert errors == sorted(errors)


def test_set_point_tracking_has_the_smaller_set_point_error():
    model = Fopdt(1.0, 10.0, 1.0)
    grid = loop_grid(model)

    def set_point_iae(gains):
        e0, p = grid.set_point_error(gains)
        return grid.integral_of(e0 - gains.b * p)

    tracking, load = design(model, Requirements(purpose=Purpose.SET_POINT)), designed(model)
    assert tracking.gains.b == 1.0
    assert set_point_iae(tracking.gains) < set_point_iae(replace(load.gains, b=1.0))
    assert load.iae < tracking.iae


@pytest.mark.parametrize("ratio", [0.1, 0.3, 0.5])
def test_an_unstable_process_relaxes_what_it_cannot_keep_and_says_so(ratio):
    model = UnstableFopdt(1.0, 10.0, 10.0 * ratio)
    found = design(model)
    assert is_stable(model, found.gains)
    assert found.requirements.Ms > 1.4 or ratio == 0.1
    assert (found.requirements.Ms > 1.4) == any("allows no sensitivity" in warning for warning in found.warnings)


@settings(max_examples=4, deadline=None)
@given(st.floats(0.02, 50.0))
def test_a_dominant_dead_time_is_no_obstacle(ratio):
    model = Fopdt(1.0, 1.0, ratio)
    found = design(model)
    assume(found.margins.stable)
    # No controller acts before two dead times; a perfect one would leave an error of 2 D (K = 1) up to its lag.
    assert found.iae >= 0.5 * model.D if ratio > 5.0 else found.iae > 0.0
    assert found.iae <= 2.2 * (model.D + model.T)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Requirements(Ms=1.0), "requirements.Ms"),
        (lambda: Requirements(Mt=math.nan), "requirements.Mt"),
        (lambda: Requirements(Ms=10.0), "requirements.Ms"),
        (lambda: Requirements(filter_ratio=0.0), "requirements.filter_ratio"),
        (lambda: Requirements(derivative_ratio=math.nan), "requirements.derivative_ratio"),
        (lambda: NoiseLimit(0.0, 1.0, 1.0), "noise.sigma"),
        (lambda: NoiseLimit(1.0, math.inf, 1.0), "noise.jitter"),
        (lambda: NoiseLimit(1.0, 1.0, -1.0), "noise.sample_time_s"),
        (lambda: design(Fopdt(1.0, 10.0, 0.0)), "model.D"),
        (lambda: design(Fopdt(1.0, 0.001, 10.0)), "model.D"),
        (lambda: design(UnstableFopdt(1.0, 1.0, 1.0)), "model.D"),
        (lambda: design(UnstableFopdt(1.0, 1.0, 0.8), Requirements(noise=NoiseLimit(1.0, 1e-3, 0.1))), "model"),
        (lambda: Fopdt(0.0, 1.0, 1.0), "model.K"),
        (lambda: Fopdt(1.0, -1.0, 1.0), "model.T"),
    ],
)
def test_what_cannot_be_designed_is_refused_by_name(make, field):
    with pytest.raises(InputError) as caught:
        make()
    assert caught.value.field == field
    assert caught.value.remedy


def test_an_unstable_process_with_a_tight_noise_limit_still_gets_its_derivative():
    """Found by many random starts of the same search: the error with derivative is 1.59, without it 3.79."""
    found = design(UnstableFopdt(1.0, 10.0, 1.0), Requirements(noise=NoiseLimit(0.01, 0.1, 0.1)))
    assert found.gains.controller == "PID"
    assert found.iae == pytest.approx(1.59, rel=0.03)
