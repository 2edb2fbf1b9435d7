"""Recordings that share no code with the product: plants integrated by Runge-Kutta, effects as differential equations.

    position = actuator(command),   v(t) = position(t - D),   dx/dt = f(x, v + load, t),   pv = h(x) + offset(t) + noise

or, of a pipe through which the position sets the flow, what leaves it on average over a sub-step, slug by slug.

Every element moves in sub-steps of a sample; the plant moves by the classical fourth-order Runge-Kutta method within
each. Nothing here has a closed form, and nothing is imported from `autotuner`, `autotuner_sim` or `autotuner_models`.
A recording is plain arrays `t, u, y` (and `sp` for a loop), without settings, segments or write times.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

Array = np.ndarray
Derivative = Callable[[Sequence[float], float, float], Sequence[float]]
SUB_STEPS = 8
"""Integration steps within a sample."""
LOADS = 8
"""Moments of a sub-step, the mean of whose loads acts over it: one that begins within acts for the rest of it."""
REST = 40.0
"""Output at which every plant rests, in percent."""


@dataclass
class Plant:
    """A linear or nonlinear process around its rest: `f(x, v, t)` with `v` as deviation from rest."""

    kind: str
    K: float
    lags: tuple[float, ...]
    D: float
    derivative: Derivative
    size: int
    measured: Callable[[Sequence[float]], float]
    start: tuple[float, ...] = ()

    @property
    def slowest(self) -> float:
        return sum(self.lags)


def chain(K: float, lags: Sequence[float], D: float, kind: str) -> Plant:
    """Return lags in series."""

    def f(x: Sequence[float], v: float, _t: float) -> Sequence[float]:
        inputs = (K * v, *x[:-1])
        return [(i - s) / T for i, s, T in zip(inputs, x, lags, strict=True)]

    return Plant(kind, K, tuple(lags), D, f, len(lags), lambda x: x[-1])


def ringing(K: float, T: float, zeta: float, D: float) -> Plant:
    def f(x: Sequence[float], v: float, _t: float) -> Sequence[float]:
        return [x[1], (K * v - x[0] - 2.0 * zeta * T * x[1]) / (T * T)]

    return Plant("ringing", K, (T, T), D, f, 2, lambda x: x[0])


def integrating(K: float, T: float, D: float) -> Plant:
    def f(x: Sequence[float], v: float, _t: float) -> Sequence[float]:
        return [(K * v - x[0]) / T, x[0]]

    return Plant("integrating", K, (T,), D, f, 2, lambda x: x[1])


def two_scales(K: float, fast: float, slow: float, share: float, D: float) -> Plant:
    def f(x: Sequence[float], v: float, _t: float) -> Sequence[float]:
        return [((1.0 - share) * K * v - x[0]) / fast, (share * K * v - x[1]) / slow]

    return Plant("two_scales", K, (fast, slow), D, f, 2, lambda x: x[0] + x[1])


class Straight:
    """An actuator that follows at once."""

    def move(self, u: float, t: float, h: float) -> float:  # noqa: ARG002
        return u


class Pipe:
    """A pipe of some volume, filled with what the actuator stood at when it came in; its flow by that, and by time."""

    def __init__(self, volume: float, flow: Callable[[float, float], float]) -> None:
        self.flow, self.slugs, self.t = flow, deque([(volume, 0.0)]), 0.0

    def move(self, position: float, h: float) -> float:
        """Return the mean of what leaves over `h` seconds."""
        wanted = h * self.flow(position, self.t)
        self.t += h
        self.slugs.append((wanted, position))
        left, carried = wanted, 0.0
        while left > 0.0:
            volume, held = self.slugs.popleft()
            taken = min(volume, left)
            carried, left = carried + taken * held, left - taken
            if volume > taken:
                self.slugs.appendleft((volume - taken, held))
        return carried / wanted


def no_load(_t: float) -> float:
    return 0.0


@dataclass
class Hidden:
    """What nobody declared: where it acts, as functions of time and state."""

    name: str = "clean"
    form: str = ""
    textbook: bool = True
    actuator: object = field(default_factory=Straight)
    load: Callable[[float], float] = no_load
    offset: Callable[[float], float] = lambda _t: 0.0
    plant: Plant | None = None
    pipe: Pipe | None = None
    gauge: Callable[[float], float] = lambda pv: pv
    """The reading of a PV, before the noise; called once a sample."""
    sensor: Callable[[Array, np.random.Generator], Array] | None = None
    jitter_samples: float = 0.0
    sizes: dict[str, float] = field(default_factory=dict)
    """True sizes, by the name that a report gives them."""
    loss: Callable[[float], float] | None = None
    """What the last store loses, over what a linear one does, at each PV over the gain; None of a linear one."""
    own_gain: bool = False
    """Whether the gain of the process beside the effect is a matter of definition: no judge of that gain."""


@dataclass
class Record:
    t: Array
    u: Array
    y: Array
    sp: Array | None
    truth: Array
    sigma: float
    plant: Plant
    hidden: Hidden

    @property
    def gain(self) -> float:
        """Gain of the process beside the effect at rest with the first output: a loop's controller answers to noise."""
        plant, loss = self.hidden.plant or self.plant, self.hidden.loss
        if loss is None:
            return plant.K
        rest = float(scipy.optimize.newton(lambda x: x + loss(x) - self.plant.K * (self.u[0] - REST), 0.0))
        step = 1e-4 * abs(self.plant.K)
        return self.plant.K / (1.0 + (loss(rest + step) - loss(rest - step)) / (2.0 * step))

    def csv(self) -> str:
        heads = "t,u,y,sp" if self.sp is not None else "t,u,y"
        columns = [self.t, self.u, self.y, *([self.sp] if self.sp is not None else [])]
        rows = (",".join(f"{v:.9g}" for v in row) for row in zip(*columns, strict=True))
        return "\n".join((heads, *rows)) + "\n"


class Policy:
    """What moves the output: called once a sample with the reading."""

    sp: float | None = None

    def __call__(self, k: int, reading: float) -> float:
        raise NotImplementedError


def runge_kutta(f: Derivative, x: list[float], v: float, t: float, h: float) -> list[float]:
    a = f(x, v, t)
    b = f([s + h / 2.0 * d for s, d in zip(x, a, strict=True)], v, t + h / 2.0)
    c = f([s + h / 2.0 * d for s, d in zip(x, b, strict=True)], v, t + h / 2.0)
    e = f([s + h * d for s, d in zip(x, c, strict=True)], v, t + h)
    return [s + h / 6.0 * (p + 2.0 * q + 2.0 * r + w) for s, p, q, r, w in zip(x, a, b, c, e, strict=True)]


def mean_load(hidden: Hidden, t: float, h: float) -> float:
    """Return the mean of the load over a sub-step."""
    if hidden.load is no_load:
        return 0.0
    return sum(hidden.load(t + h * (k + 0.5) / LOADS) for k in range(LOADS)) / LOADS


def run(
    plant: Plant, hidden: Hidden, policy: Policy, n: int, dt: float, noise: Array, rng: np.random.Generator
) -> tuple:
    """Return times, outputs, true and measured PV, and set points."""
    p = hidden.plant or plant
    f, D, h = p.derivative, p.D, dt / SUB_STEPS
    pv0 = 60.0
    x = list(p.start) or [0.0] * p.size
    behind = [0.0] * (int(D / h) + 3)
    whole, part = int(D / h), D / h - int(D / h)
    shift = rng.uniform(-0.5, 0.5, n) * hidden.jitter_samples * SUB_STEPS
    times, outputs, truth, readings, points = (np.empty(n) for _ in range(5))
    recent: list[float] = [0.0] * SUB_STEPS
    u = REST
    reading = pv0 + noise[0]
    for k in range(n):
        t = k * dt
        clean = hidden.gauge(p.measured(x)) + hidden.offset(t)
        late = clean
        if shift[k] < 0.0:
            back = -shift[k]
            i = min(int(back), SUB_STEPS - 2)
            late = recent[-1 - i] + (back - i) * (recent[-2 - i] - recent[-1 - i])
        reading = pv0 + late + noise[k]
        u = policy(k, reading)
        times[k], outputs[k], truth[k], readings[k] = t, u, pv0 + clean, reading
        points[k] = math.nan if policy.sp is None else policy.sp
        for j in range(SUB_STEPS):
            at = t + j * h
            position = hidden.actuator.move(u, at, h) - REST  # type: ignore[attr-defined]
            behind.append(position if hidden.pipe is None else hidden.pipe.move(position, h))
            v = behind[-1 - whole] * (1.0 - part) + behind[-2 - whole] * part
            x = runge_kutta(f, x, v + mean_load(hidden, at, h), at, h)
            recent.append(p.measured(x) + hidden.offset(at + h))
        recent = recent[-SUB_STEPS - 2 :]
        if len(behind) > 4 * whole + 100:
            behind = behind[-whole - 3 :]
    return times, outputs, truth, readings, points


class Levels(Policy):
    def __init__(self, levels: Sequence[float]) -> None:
        self.levels = levels

    def __call__(self, k: int, reading: float) -> float:  # noqa: ARG002
        return self.levels[k]


class Relay(Policy):
    """A biased relay with hysteresis, then half of it, then holds up and down, then another level."""

    def __init__(self, h: float, bias: float, eps: float, quiet: int, per: int, sign: float, n: int) -> None:
        self.h, self.bias, self.eps, self.quiet, self.per, self.sign, self.n = h, bias, eps, quiet, per, sign, n
        self.up, self.rest = True, 60.0

    def __call__(self, k: int, reading: float) -> float:
        if k < self.quiet:
            return REST
        share = (k - self.quiet) / max(self.n - self.quiet, 1)
        e = self.sign * (reading - self.rest)
        if e > self.eps:
            self.up = False
        elif e < -self.eps:
            self.up = True
        if share < 0.75:
            size = self.h if share < 0.45 else self.h / 2.0
            return REST + self.bias + (size if self.up else -size)
        stairs = (0.25, 0.5, 0.25, -0.1, -0.5, -0.25, 0.4)
        step = min(int((share - 0.75) / 0.25 * len(stairs)), len(stairs) - 1)
        return REST + self.h * stairs[step]


class Loop(Policy):
    """A PI controller; the set point moves."""

    def __init__(self, Kp: float, Ti: float, dt: float, points: Sequence[float]) -> None:
        self.Kp, self.Ti, self.dt, self.points, self.integral = Kp, Ti, dt, points, 0.0

    def __call__(self, k: int, reading: float) -> float:
        self.sp = self.points[k]
        e = self.sp - reading
        u = REST + self.Kp * (e + self.integral)
        clipped = min(max(u, 0.0), 100.0)
        if clipped == u:
            self.integral += e * self.dt / self.Ti
        return clipped


def levels_of(
    rng: np.random.Generator, n: int, swing: float, low: int, high: int, start: int, *, binary: bool
) -> list[float]:
    levels = [REST] * start
    sign = 1.0
    while len(levels) < n:
        sign = -sign
        size = swing * (1.0 if rng.random() < 0.7 else 0.4) if binary else swing * rng.uniform(0.2, 1.0)
        levels += [REST + sign * size] * int(rng.integers(low, high + 1))
    return levels[:n]


def policy_of(
    kind: str, plant: Plant, rng: np.random.Generator, dt: float, swing: float, sigma: float, n: int
) -> Policy:
    per = max(int((plant.slowest + plant.D) / dt), 2)
    if kind == "relay":
        return Relay(
            swing, rng.uniform(-0.25, 0.25) * swing, 3.0 * sigma, max(n // 20, 12), per, math.copysign(1.0, plant.K), n
        )
    if kind == "steps":
        return Levels(levels_of(rng, n, swing, per, 4 * per, max(n // 25, 5), binary=False))
    if kind == "random":
        return Levels(levels_of(rng, n, swing, max(per // 3, 2), 2 * per, max(n // 25, 5), binary=True))
    if kind == "short":
        first, second = n // 8, n // 2
        return Levels([REST + swing * (0.0 if k < first else 1.0 if k < second else -0.4) for k in range(n)])
    slow = plant.slowest + plant.D
    Kp, Ti = (0.35 / plant.K) * (plant.slowest / (plant.D + 0.15 * slow)), 0.8 * slow
    if plant.kind == "integrating":
        Kp, Ti = 0.3 / (plant.K * (plant.D + plant.lags[0])), 6.0 * (plant.D + plant.lags[0])
    size = abs(plant.K) * swing * (1.0 if plant.kind != "integrating" else 3.0 * slow)
    points, at = [60.0] * max(n // 25, 5), 0.0
    while len(points) < n:
        at = rng.uniform(-0.7, 0.7) * size
        points += [60.0 + at] * int(rng.integers(3 * per, 7 * per + 1))
    return Loop(Kp, Ti, dt, points)


def noise_of(kind: str, sigma: float, n: int, rng: np.random.Generator) -> Array:
    if kind == "coloured":
        w, a = rng.standard_normal(n + 50), rng.uniform(0.6, 0.9)
        e = np.empty(n + 50)
        last = 0.0
        for k, v in enumerate(w):
            last = a * last + v
            e[k] = last
        e = e[50:]
        return sigma * e * math.sqrt(1.0 - a * a)
    if kind == "heavy":
        return sigma * rng.standard_t(3, n) / math.sqrt(3.0)
    return sigma * rng.standard_normal(n)


def plant_of(rng: np.random.Generator, kind: str | None = None) -> Plant:
    kind = kind or str(rng.choice(["first", "second", "ringing", "third"], p=[0.35, 0.4, 0.15, 0.1]))
    K = float(rng.choice([-1.0, 1.0], p=[0.25, 0.75]) * math.exp(rng.uniform(math.log(0.4), math.log(3.0))))
    T = math.exp(rng.uniform(math.log(4.0), math.log(300.0)))
    D = T * math.exp(rng.uniform(math.log(0.08), math.log(1.2)))
    if kind == "first":
        return chain(K, (T,), D, kind)
    if kind == "second":
        return chain(K, (T, T * rng.uniform(0.2, 0.9)), D, kind)
    if kind == "third":
        return chain(K, (T, T * rng.uniform(0.3, 0.8), T * rng.uniform(0.1, 0.3)), D, kind)
    if kind == "ringing":
        return ringing(K, T, rng.uniform(0.3, 0.75), 0.5 * D)
    if kind == "two_scales":
        return two_scales(K, T, T * rng.uniform(6.0, 15.0), rng.uniform(0.2, 0.5), D)
    return integrating(K / T, 0.5 * T, 0.5 * D)
