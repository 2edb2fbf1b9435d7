"""The relay test beside a controller, against Tsypkin's series, a relay alone, and the balance of fundamentals."""

import cmath
import math

import numpy as np
import pytest
from scipy.optimize import brentq

from autotuner_sim.plants import Fopdt, SopdtOverdamped, SopdtUnderdamped
from autotuner_sim.relay import Relay, symmetric_relay
from autotuner_sim.relay.limit_cycle import find_limit_cycle
from autotuner_sim.relay.parallel_pid import Pid, run_parallel_relay

ODD = np.arange(1, 20_001, 2)
PLANT = Fopdt(1.0, 10.0, 2.0)


def controller(pid: Pid, s):
    return pid.Kp * (1.0 + 1.0 / pid.Ti / s + s * pid.Td) / (1.0 + s * pid.Tf + (s * pid.Tf) ** 2 / 2.0)


def by_tsypkin(plant, pid: Pid, low: float, high: float):
    """Period, peak and fundamental under an ideal relay of height 1: the series of `H = G/(1 + Gc G)` at odd harmonics.

    The square wave of frequency `w` answers at its own switch with `4/pi sum Im H(jkw)/k`, which must be 0.
    """

    def closed_loop(w: float):
        G = np.array([plant.transfer(1j * w * k) for k in ODD])
        return G / (1.0 + controller(pid, 1j * w * ODD) * G)

    w = brentq(lambda w: float((closed_loop(w).imag / ODD).sum()), low, high, xtol=1e-12)
    harmonics = 4.0 / math.pi * closed_loop(w) / ODD
    spectrum = np.zeros(1 << 15, dtype=complex)
    spectrum[ODD] = harmonics / 1j * (spectrum.size - 1)
    return 2.0 * math.pi / w, float(np.fft.irfft(spectrum).max()), float(abs(harmonics[0]))


@pytest.mark.one_of(2)
@pytest.mark.parametrize(
    ("plant", "pid", "bracket"),
    [
        (PLANT, Pid(4.2, 3.67, 0.92, 0.092), (0.9, 1.0)),
        (PLANT, Pid(3.16, 6.1), (0.75, 0.85)),
        (PLANT, Pid(2.0), (0.8, 0.9)),
        (SopdtOverdamped(1.0, 10.0, 1.0, 2.0), Pid(2.0, 9.0, 1.0, 0.1), (0.5, 0.8)),
        (SopdtUnderdamped(1.0, 9.0, 2.4, 1.0), Pid(0.5, 8.0), (0.4, 0.7)),
    ],
    ids=["PID", "PI", "P", "overdamped, PID", "underdamped, PI"],
)
def test_period_and_amplitudes_are_those_of_the_series(plant, pid, bracket):
    period_s, peak, fundamental = by_tsypkin(plant, pid, *bracket)
    run = run_parallel_relay(plant, symmetric_relay(), pid, 30.0 * period_s, 0.01)
    assert run.period_s == pytest.approx(period_s, rel=1e-5)
    assert run.peak == pytest.approx(peak, rel=1e-4)
    assert run.fundamental == pytest.approx(fundamental, rel=1e-4)


def test_the_error_falls_with_the_square_of_the_step():
    pid = Pid(4.2, 3.67, 0.92, 0.092)
    exact, _, _ = by_tsypkin(PLANT, pid, 0.9, 1.0)
    errors = [
        abs(run_parallel_relay(PLANT, symmetric_relay(), pid, 150.0, step_s).period_s / exact - 1.0)
        for step_s in (0.08, 0.02)
    ]
    assert errors[0] / errors[1] > 8.0


def test_without_a_controller_it_is_the_relay_alone():
    run = run_parallel_relay(PLANT, symmetric_relay(hysteresis=0.02), Pid(1e-12), 100.0, 0.02)
    cycle = find_limit_cycle(PLANT, symmetric_relay(hysteresis=0.02))
    assert run.period_s == pytest.approx(cycle.period_s, rel=1e-9)
    assert run.peak == pytest.approx(cycle.peak, rel=1e-9)
    assert run.fundamental == pytest.approx(cycle.fundamental, rel=1e-4)


def test_fundamentals_balance():
    """`(U1/Y1 + Gc) G = -1` with the relay's true fundamental, whatever the dead zone: by hand from the run."""
    pid, relay = Pid(3.0, 6.0, 0.5, 0.05), symmetric_relay(hysteresis=0.03)
    run = run_parallel_relay(PLANT, relay, pid, 200.0, 0.01)
    w = 2.0 * math.pi / run.period_s
    rows = (run.t >= run.switches_s[-3]) & (run.t <= run.switches_s[-1])
    t, pv = run.t[rows], run.pv[rows]
    Y = np.trapezoid((pv - pv.mean()) * np.exp(-1j * w * t), t) * 2.0 / run.period_s
    start, middle, end = run.switches_s[-3:]
    level = float(run.relay[np.searchsorted(run.t, (start + middle) / 2.0)])
    U = sum(
        sign * (cmath.exp(-1j * w * a) - cmath.exp(-1j * w * b))
        for sign, a, b in ((1, start, middle), (-1, middle, end))
    ) * (level / (1j * w) * 2.0 / run.period_s)
    balance = (-U / Y + controller(pid, 1j * w)) * PLANT.transfer(1j * w)
    assert balance == pytest.approx(-1.0, abs=2e-4)


def test_a_relay_off_its_rest_starts_on_the_side_that_leads_there():
    above = run_parallel_relay(PLANT, Relay(-1.0, 1.0, reference=-0.05), Pid(1.0), 0.5, 0.05)
    assert set(above.relay) == {-1.0}


def test_a_plant_without_dead_time_is_refused():
    with pytest.raises(ValueError, match="dead time"):
        run_parallel_relay(Fopdt(1.0, 10.0, 0.0), symmetric_relay(hysteresis=0.1), Pid(1.0), 10.0, 0.1)
