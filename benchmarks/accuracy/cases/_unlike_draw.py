"""Plants and circumstances unlike those of the other benches, drawn by seed.

Fourth order, rings behind a lag, zeros on either side, integrators with lags, slow modes; from 20 ms to hours, 8 to 100
samples a period. A plant is drawn in a time of its own and moved in seconds by `Scaled`. Sizes are set in what its
relay cycle shows by the describing function: relay amplitude `h`, amplitude `A` of the PV, period `P`.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from autotuner_sim import (
    ActuatorHold,
    Backlash,
    ColouredNoise,
    DirectionGain,
    Drift,
    LoadRamp,
    LoadStep,
    Noise,
    OutputQuantisation,
    PeriodicLoad,
    Quantisation,
    RateLimit,
    RationalPlant,
    Saturation,
    Stiction,
)

OUTPUT0, PV0 = 40.0, 80.0


@dataclass(frozen=True)
class Scaled:
    """`G(s scale)` of a plant given in another time."""

    inner: RationalPlant
    scale: float

    @property
    def D(self):
        return self.inner.D * self.scale

    @property
    def rest(self):
        return self.inner.motion().rest

    def motion(self):
        return self

    def move(self, x, u, h):
        return self.inner.motion().move(x, u, h / self.scale)

    def output(self, x):
        return self.inner.motion().output(x)


def rational(b, a, D, *lags):
    """Return `b/a e^{-Ds}` behind lags."""
    plant = RationalPlant(tuple(map(float, b)), tuple(map(float, a)), float(D))
    for lag in lags:
        plant = plant.times((1.0,), (1.0, float(lag)))
    return plant


def ringing(rng):
    w, damping = rng.uniform(0.7, 8.0), rng.uniform(0.08, 0.6)
    return rational((1,), (1, 1), rng.uniform(0.02, 0.8)).times((1.0,), (1.0, 2.0 * damping / w, 1.0 / w**2))


def two_speeds(rng):
    share = rng.uniform(0.2, 0.7)
    quick = rational((1.0 - share,), (1, 1), 10 ** rng.uniform(-1.3, -0.1))
    return quick.beside((share,), (1.0, 10 ** rng.uniform(0.7, 1.7)))


def wrong_way(rng):
    lags = rng.uniform(0.05, 0.5, int(rng.integers(0, 2)))
    return rational((1, -rng.uniform(0.1, 1.5)), (1, 1, rng.uniform(0.05, 0.25)), rng.uniform(0.3, 4.0), *lags)


def ahead(rng):
    lag = rng.uniform(0.3, 2.0)
    return rational((1, rng.uniform(0.5, 4.0)), (1, 1 + lag, lag), rng.uniform(0.1, 1.0), rng.uniform(0.05, 0.5))


PLANTS = {
    "chain": lambda rng: rational((1,), (1, 1), rng.uniform(0.02, 0.6), *10 ** rng.uniform(-1, 0, rng.integers(2, 6))),
    "fourth order": lambda rng: rational((1,), (1, 1), rng.uniform(0.02, 0.3), *rng.uniform(0.3, 1.0, 3)),
    "ringing": ringing,
    "wrong way first": wrong_way,
    "ahead": ahead,
    "two speeds": two_speeds,
    "integrating": lambda rng: rational((1,), (0, 1), rng.uniform(0.1, 1), *rng.uniform(0.05, 3, rng.integers(1, 4))),
    "nearly integrating": lambda rng: rational((30,), (1, 30), rng.uniform(0.1, 1.0), rng.uniform(0.05, 2.0)),
    "slow unstable": lambda rng: rational((1,), (-1, 1), rng.uniform(0.03, 0.35)),
    "delay": lambda rng: rational((1,), (1, rng.uniform(0.02, 0.2)), 1, *rng.uniform(0.02, 0.3, rng.integers(0, 3))),
}


@dataclass
class Around:
    """What is put around a plant; `gains` are those of its directions, `later_s` a further dead time of the loop."""

    actuators: list = field(default_factory=list)
    loads: list = field(default_factory=list)
    offsets: list = field(default_factory=list)
    quantisation: list = field(default_factory=list)
    noise: object = None
    gains: tuple = (1.0,)
    later_s: float = 0.0
    limits: dict = field(default_factory=dict)
    turned: bool = False


def direction_gain(around, _h, _A, _P, _dt, rng):
    ratio = float(rng.uniform(1.3, 4.0) ** rng.choice([-1, 1]))
    around.actuators.append(DirectionGain(ratio))
    around.gains = (1.0, ratio)


def actuator_hold(around, _h, _A, P, _dt, rng):
    period_s = rng.uniform(0.02, 0.2) * P
    around.actuators.append(ActuatorHold(period_s))
    around.later_s = period_s / 2.0


def drift(around, _h, A, P, dt, rng):
    around.offsets.append(Drift(rng.uniform(-0.3, 0.3) * A / P, 60.0 * dt))


def coloured(around, _h, A, _P, dt, rng):
    around.noise = ColouredNoise(rng.uniform(0.005, 0.06) * A, rng.uniform(2.0, 60.0) * dt, int(rng.integers(2**31)))


def noisy(around, _h, A, _P, _dt, rng):
    around.noise = Noise(rng.uniform(0.03, 0.2) * A, int(rng.integers(2**31)))


def tight_limits(around, _h, A, _P, _dt, rng):
    around.limits = {"pv": [PV0 - rng.uniform(0.3, 3.0) * A, PV0 + rng.uniform(0.3, 3.0) * A]}


def turned(around, *_):
    around.turned = True


def adds(kind, make):
    """Return a circumstance that adds one object to a list."""
    return lambda around, h, A, P, _dt, rng: getattr(around, kind).append(make(h, A, P, rng))


CIRCUMSTANCES = {
    "nothing": lambda *_: None,
    "play": adds("actuators", lambda h, _A, _P, rng: Backlash(rng.uniform(0.05, 1.0) * h)),
    "stiction": adds("actuators", lambda h, _A, _P, rng: Stiction(rng.uniform(0.05, 1.0) * h)),
    "coarse steps": adds("actuators", lambda h, _A, _P, rng: OutputQuantisation(rng.uniform(0.05, 1.0) * h)),
    "rate limit": adds("actuators", lambda h, _A, P, rng: RateLimit(2.0 * h / (rng.uniform(0.05, 0.8) * P))),
    "saturation": adds("actuators", lambda h, _A, _P, rng: Saturation(0.0, OUTPUT0 + rng.uniform(0.2, 1.5) * h)),
    "gain by direction": direction_gain,
    "actuator hold": actuator_hold,
    "coarse PV": adds("quantisation", lambda _h, A, _P, rng: Quantisation(rng.uniform(0.02, 0.8) * A)),
    "load step": adds("loads", lambda h, _A, P, rng: LoadStep(rng.uniform(2, 15) * P, rng.uniform(-0.8, 0.8) * h)),
    "load ramp": adds(
        "loads",
        lambda h, _A, P, rng: LoadRamp(rng.uniform(1, 9) * P, rng.uniform(-0.8, 0.8) * h, rng.uniform(1, 6) * P),
    ),
    "swinging load": adds(
        "loads", lambda h, _A, P, rng: PeriodicLoad(rng.uniform(0.03, 0.4) * h, rng.uniform(0.2, 6.0) * P, "sine", 0.0)
    ),
    "drift": drift,
    "coloured noise": coloured,
    "much noise": noisy,
    "tight PV limits": tight_limits,
    "action turned": turned,
}
"""By name, what changes an `Around` for a relay `h`, a cycle of amplitude `A` and period `P`, and a sample time."""


def ultimate(plant):
    """Return the period and the gain at the crossing of -180 degrees with the largest response; None without one."""
    w = np.geomspace(1e-3, 1e3, 60_000)
    s = 1j * w
    g = np.polyval(plant.b[::-1], s) / np.polyval(plant.a[::-1], s) * np.exp(-plant.D * s)
    rows = np.flatnonzero((g.imag[:-1] < 0.0) & (g.imag[1:] >= 0.0) & (g.real[1:] < 0.0))
    if not rows.size:
        return None
    row = rows[np.argmax(np.abs(g[rows]))]
    return 2.0 * math.pi / float(w[row]), 1.0 / float(abs(g[row]))
