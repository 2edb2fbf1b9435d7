"""Recordings of simulated tests, made sample by sample: what a real controller would have recorded."""

import cmath
import math

import numpy as np
import pytest

from autotuner.core.recording import Recording
from autotuner.core.signals.limit_cycle import LimitCycle
from autotuner_sim.relay.limit_cycle import find_limit_cycle
from autotuner_sim.stepped import SteppedPlant

HORIZON = 60_000


def sampled(plant, dt, output_at, samples, *, sigma=0.0, quantum=0.0, seed=0, rest=0.0, pv0=0.0):
    """Drive a plant with `output_at(k, pv)` every `dt` seconds; `None` ends the recording."""
    rng = np.random.default_rng(seed)
    device = SteppedPlant(plant, output0=rest, pv0=pv0)
    rows = []
    for k in range(samples):
        device.advance(k * dt)
        pv = device.pv + sigma * rng.standard_normal()
        pv = round(pv / quantum) * quantum if quantum else pv
        output = output_at(k, pv)
        if output is None:
            break
        device.output = output
        rows.append((k * dt, output, pv))
    return Recording(*np.array(rows).T)


def relay_record(
    plant,
    dt,
    *,
    switches=5,
    low=-1.0,
    high=2.0,
    quiet=30,
    rest=0.0,
    reference=0.0,
    hysteresis=0.0,
    tail=0.3,
    **measured,
):
    """A relay test from rest, ended a while after so many switches."""
    state = {"high": True, "rows": []}

    def output_at(k, pv):
        if k < quiet:
            return rest
        error = (pv - reference) * math.copysign(1.0, plant.K)
        was = state["high"]
        if k > quiet and abs(error) > hysteresis:
            state["high"] = error < 0.0
        if state["high"] != was:
            state["rows"].append(k)
        done = len(state["rows"]) >= switches
        if done and k > state["rows"][-1] + tail * (state["rows"][-1] - quiet) / switches:
            return None
        return high if state["high"] else low

    return sampled(plant, dt, output_at, HORIZON, rest=rest, **measured)


def exact_cycle(plant, relay):
    """The exact limit cycle of the simulator, as if it had been measured."""
    cycle = find_limit_cycle(plant, relay)
    lowest, highest = cycle.extremes
    at_rise, at_fall = (relay.threshold(is_high=is_high)[0] for is_high in (False, True))
    h = (relay.high - relay.low) / 2.0
    lag = -cmath.phase(plant.transfer(2j * math.pi / cycle.period_s)) % (2.0 * math.pi)
    return LimitCycle(
        Pu=cycle.period_s,
        A=cycle.peak,
        A1=cycle.fundamental,
        h=h,
        bias=(relay.high + relay.low) / 2.0,
        relay_fundamental=4.0 * h / math.pi * math.sin(math.pi * cycle.high_s / cycle.period_s),
        hysteresis=relay.hysteresis,
        high_s=cycle.high_s,
        low_s=cycle.low_s,
        lowest=lowest,
        highest=highest,
        pv_at_rise=at_rise,
        pv_at_fall=at_fall,
        cycles=1,
        lag_rad=lag,
    )


@pytest.fixture(scope="session")
def record_relay():
    return relay_record


@pytest.fixture(scope="session")
def record():
    return sampled


@pytest.fixture(scope="session")
def cycle_of():
    return exact_cycle
