"""Oracles that share nothing with the simulator: matrices of the transfer function and a fine fixed-step loop."""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

SHARED = Path(__file__).parents[2].parent / "shared"


@pytest.fixture
def thesis_limit_cycles() -> Path:
    path = SHARED / "thesis" / "limit_cycles.csv"
    if not path.exists():
        pytest.skip(f"reference data {path} are not here")
    return path


def polynomials(plant) -> tuple[list[float], list[float]]:
    """Numerator and denominator of the delay-free part, highest power first, as the textbook has them."""
    p = {name: getattr(plant, name) for name in plant.__dataclass_fields__}
    return {
        "fopdt": lambda: ([p["K"]], [p["T"], 1.0]),
        "sopdt_overdamped": lambda: ([p["K"]], np.polymul([p["T1"], 1.0], [p["T2"], 1.0])),
        "sopdt_underdamped": lambda: ([p["K"]], [p["m"], p["n"], 1.0]),
        "integrating": lambda: ([p["K"]], [p["T"], 1.0, 0.0]),
        "unstable_fopdt": lambda: ([p["K"]], [p["T"], -1.0]),
        "inverse_response": lambda: ([-p["K"] * p["Z"], p["K"]], np.polymul([p["T1"], 1.0], [p["T2"], 1.0])),
        "lag_chain": lambda: ([p["K"]], np.poly1d(1.0) * _product(p["lags"])),
    }[plant.structure]()


def _product(lags):
    product = np.poly1d([1.0])
    for lag in lags:
        product = product * np.poly1d([lag, 1.0])
    return product


class Oracle:
    """Held-input response and relay test computed the slow, plain way."""

    @staticmethod
    def held_response(plant, inputs, dt: float) -> np.ndarray:
        """PV after each of the held inputs, from rest, without dead time: zero-order-hold matrices and a loop."""
        num, den = polynomials(plant)
        a, b, c, d = scipy.signal.tf2ss(np.atleast_1d(num), np.atleast_1d(den))
        phi, gamma, c, _, _ = scipy.signal.cont2discrete((a, b, c, d), dt, method="zoh")
        x, out = np.zeros((a.shape[0], 1)), []
        for u in inputs:
            x = phi @ x + gamma * u
            out.append(float((c @ x)[0, 0]))
        return np.array(out)

    @staticmethod
    def relay_by_euler(plant, relay, end_s: float, dt: float) -> np.ndarray:
        """Switch times of a fine fixed-step simulation; each is late by up to one step."""
        num, den = polynomials(plant)
        a, b, c, _ = scipy.signal.tf2ss(np.atleast_1d(num), np.atleast_1d(den))
        phi = scipy.linalg.expm(np.block([[a, b], [np.zeros((1, a.shape[0] + 1))]]) * dt)
        rows, column, weights = phi[:-1, :-1].tolist(), phi[:-1, -1].tolist(), c[0].tolist()
        x, order, switches, is_high = [0.0] * a.shape[0], range(a.shape[0]), [], True
        pipe = deque([0.0] * round(plant.D / dt))
        for step in range(round(end_s / dt)):
            y = sum(weights[i] * x[i] for i in order) - relay.reference
            y = y if relay.direct else -y
            if (is_high and y > relay.hysteresis + 1e-12) or (not is_high and y < -relay.hysteresis - 1e-12):
                is_high = not is_high
                switches.append(step * dt)
            pipe.append(relay.high if is_high else relay.low)
            u = pipe.popleft()
            x = [sum(rows[i][j] * x[j] for j in order) + column[i] * u for i in order]
        return np.array(switches)


@pytest.fixture
def oracle() -> type[Oracle]:
    return Oracle


def _by_every_sample(plant, relay, noise, dt, switches):
    """The first position and the samples of the switches, from the exact state at every sample.

    The relay's output reaches the plant at the same fraction of every sample, so each takes two steps.
    """
    whole = math.floor(plant.D / dt)
    part = plant.D / dt - whole
    motion = plant.motion()
    x, is_high, levels, found = motion.rest, True, [], []
    for i, e in enumerate(noise):
        threshold, way = relay.threshold(is_high=is_high)
        if way * (motion.output(x) + e - threshold) > 0.0:
            is_high = not is_high
            found.append(i)
        levels.append(relay.level(is_high=is_high))
        if len(found) - (found[:1] == [0]) == switches:
            break
        arrived = [levels[k] if k >= 0 else 0.0 for k in (i - whole - 1, i - whole)]
        x = motion.move(motion.move(x, arrived[0], part * dt), arrived[1], (1.0 - part) * dt)
    return (False, found[1:]) if found[:1] == [0] else (True, found)


@pytest.fixture(scope="session")
def by_every_sample():
    return _by_every_sample
