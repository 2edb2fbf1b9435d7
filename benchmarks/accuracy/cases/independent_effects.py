"""Effects for `independent_plants`, each in its textbook form and in forms that no textbook has.

A form is a function of a `Draw`: the plant, a random generator, the output's swing, the PV's motion and the length of
the record. It returns a `Hidden`.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from benchmarks.accuracy.cases.independent_plants import REST, Array, Derivative, Hidden, Pipe, Plant, Straight, chain


@dataclass
class Draw:
    """What the size of an effect is drawn from."""

    plant: Plant
    rng: np.random.Generator
    swing: float
    motion: float
    span_s: float

    @property
    def slow_s(self) -> float:
        return slow_of(self.plant)

    def between(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def either(self) -> float:
        return float(self.rng.choice([-1.0, 1.0]))


Make = Callable[[Draw], Hidden]
FORMS: dict[str, tuple[str, str, bool, Make]] = {}
"""By `name:form`: name, form, whether a textbook has it, and what makes it."""


def form(name: str, kind: str, *, textbook: bool) -> Callable[[Make], Make]:
    def keep(make: Make) -> Make:
        FORMS[f"{name}:{kind}"] = (name, kind, textbook, make)
        return make

    return keep


def slow_of(plant: Plant) -> float:
    return plant.slowest + plant.D


class Backlash:
    def __init__(self, width: float, softness_s: float = 0.0) -> None:
        self.half, self.softness_s, self.at = width / 2.0, softness_s, REST

    def move(self, u: float, _t: float, h: float) -> float:
        goal = min(max(self.at, u - self.half), u + self.half)
        self.at = goal if self.softness_s == 0.0 else self.at + (goal - self.at) * min(h / self.softness_s, 1.0)
        return self.at


class Stiction:
    """Sticks until the command is `stick` away from where it stopped, then slips to within `slip` of it."""

    def __init__(self, stick: float, slip: float) -> None:
        self.stick, self.slip, self.at = stick, slip, REST

    def move(self, u: float, _t: float, _h: float) -> float:
        if abs(u - self.at) > self.stick:
            self.at = u - math.copysign(self.slip, u - self.at)
        return self.at


class Karnopp:
    """A stem with a mass, viscous friction, Coulomb friction and a static level, pulled by a spring to the command."""

    def __init__(self, static: float, coulomb: float, tau_s: float) -> None:
        self.static, self.coulomb, self.tau, self.at, self.speed = static, coulomb, tau_s, REST, 0.0

    def move(self, u: float, _t: float, h: float) -> float:
        steps = max(int(4.0 * h / self.tau) + 1, 4)
        for _ in range(min(steps, 40)):
            d = h / steps
            pull = u - self.at
            if abs(self.speed) < 1e-3 * self.coulomb / self.tau and abs(pull) <= self.static:
                self.speed = 0.0
                break
            way = math.copysign(1.0, self.speed or pull)
            force = pull - self.coulomb * way - 2.0 * self.tau * self.speed
            speed = self.speed + d * force / (self.tau**2 + 2.0 * self.tau * d)
            self.speed = 0.0 if self.speed * speed < 0.0 else speed
            self.at += d * self.speed
        return self.at


class Curve:
    def __init__(self, f: Callable[[float], float]) -> None:
        self.f = f

    def move(self, u: float, _t: float, _h: float) -> float:
        return self.f(u)


class Rate:
    def __init__(self, up: float, down: float, soft: float = 0.0) -> None:
        self.up, self.down, self.soft, self.at = up, down, soft, REST

    def move(self, u: float, _t: float, h: float) -> float:
        e = u - self.at
        most = self.up if e > 0.0 else self.down
        if self.soft:
            self.at += most * h * math.tanh(e / self.soft)
        else:
            self.at += math.copysign(min(abs(e), most * h), e)
        return self.at


class Steps:
    def __init__(self, edges: np.ndarray) -> None:
        self.edges = edges

    def move(self, u: float, _t: float, _h: float) -> float:
        return float(self.edges[np.argmin(np.abs(self.edges - u))])


class Hold:
    def __init__(self, times: np.ndarray) -> None:
        self.times, self.next, self.at = times, 0, REST

    def move(self, u: float, t: float, h: float) -> float:
        """Return the mean of a step: an update may lie within it."""
        mean = self.at
        while self.next < len(self.times) and self.times[self.next] < t + h - 1e-9:
            mean += (u - self.at) * min((t + h - self.times[self.next]) / h, 1.0)
            self.at = u
            self.next += 1
        return mean


class Switch:
    """On for a share of each period: of its first command, or as long as the command is above a rising carrier."""

    def __init__(self, period: float, *, latched: bool) -> None:
        self.period, self.latched, self.turn, self.share = period, latched, -1, 0.0

    def move(self, u: float, t: float, h: float) -> float:
        """Return the mean of a step: a pulse may begin or end within it."""
        on = self._on(t, h)
        turn = math.floor((t + h) / self.period + 1e-9)
        if turn > self.turn or not self.latched:
            new = turn > self.turn
            self.turn, self.share = turn, u / 100.0
            on = on + self._on(t, h) if new else self._on(t, h)
        return 100.0 * on / h

    def _on(self, t: float, h: float) -> float:
        begins = self.turn * self.period
        return max(min(t + h, begins + self.share * self.period) - max(t, begins), 0.0)


class Lags:
    def __init__(self, up_s: float, down_s: float) -> None:
        self.up, self.down, self.at = up_s, down_s, REST

    def move(self, u: float, _t: float, h: float) -> float:
        lag = self.up if u > self.at else self.down
        self.at += (u - self.at) * (1.0 - math.exp(-h / lag))
        return self.at


@form("backlash", "play", textbook=True)
def play(d: Draw) -> Hidden:
    width = d.between(0.15, 0.5) * d.swing
    return Hidden(actuator=Backlash(width), sizes={"width": width})


@form("backlash", "compliant", textbook=False)
def compliant_play(d: Draw) -> Hidden:
    return Hidden(actuator=Backlash(d.between(0.2, 0.5) * d.swing, 0.05 * d.slow_s))


@form("stiction", "stick and slip", textbook=True)
def stick_and_slip(d: Draw) -> Hidden:
    band = d.between(0.2, 0.5) * d.swing
    slip = d.between(0.0, 0.3) * band
    return Hidden(actuator=Stiction(band, slip), sizes={"jump": band - slip})


@form("stiction", "mass and Coulomb", textbook=False)
def stem_with_mass(d: Draw) -> Hidden:
    band = d.between(0.2, 0.45) * d.swing
    return Hidden(actuator=Karnopp(band, d.between(0.2, 0.5) * band, 0.02 * d.slow_s))


@form("saturation", "hard", textbook=True)
def hard_limit(d: Draw) -> Hidden:
    top = REST + d.between(0.1, 0.6) * d.swing
    return Hidden(actuator=Curve(lambda v: min(v, top)), sizes={"high": top})


@form("saturation", "tanh", textbook=False)
def soft_limits(d: Draw) -> Hidden:
    width = d.between(0.6, 1.0) * d.swing
    limits = {"low": REST - width, "high": REST + width}
    return Hidden(actuator=Curve(lambda v: REST + width * math.tanh((v - REST) / width)), sizes=limits)


@form("saturation", "rounded knee", textbook=False)
def rounded_knee(d: Draw) -> Hidden:
    top, width = REST + d.between(0.1, 0.5) * d.swing, 0.15 * d.swing
    knee = Curve(lambda v: v - width * math.log1p(math.exp(min((v - top) / width, 50.0))))
    return Hidden(actuator=knee, sizes={"high": top}, own_gain=True)


@form("rate_limit", "equal", textbook=True)
def one_rate(d: Draw) -> Hidden:
    rate = d.between(0.5, 2.5) * d.swing / d.slow_s
    return Hidden(actuator=Rate(rate, rate), sizes={"rate_per_s": rate})


@form("rate_limit", "unequal", textbook=False)
def two_rates(d: Draw) -> Hidden:
    rate = d.between(0.5, 1.5) * d.swing / d.slow_s
    falling = d.between(1.6, 3.0) * rate
    return Hidden(actuator=Rate(rate, falling), sizes={"rate_per_s": rate, "falling_rate_per_s": falling})


@form("rate_limit", "soft", textbook=False)
def soft_rate(d: Draw) -> Hidden:
    rate = d.between(0.6, 1.5) * d.swing / d.slow_s
    return Hidden(actuator=Rate(rate, rate, 0.2 * d.swing))


@form("output_quantisation", "even", textbook=True)
def even_steps(d: Draw) -> Hidden:
    step = d.between(0.2, 0.6) * d.swing
    return Hidden(actuator=Curve(lambda v: step * round(v / step)), sizes={"step": step})


@form("output_quantisation", "unequal", textbook=False)
def unequal_steps(d: Draw) -> Hidden:
    levels = REST + (np.cumsum(d.rng.uniform(0.25, 0.6, 16)) - 3.0) * d.swing
    return Hidden(actuator=Steps(levels), own_gain=True)


@form("actuator_hold", "even", textbook=True)
def even_updates(d: Draw) -> Hidden:
    every = d.between(0.3, 0.7) * d.slow_s
    updates = np.arange(0.0, d.span_s, every) + d.between(0.0, 1.0) * every
    return Hidden(actuator=Hold(updates), sizes={"period_s": every})


@form("actuator_hold", "uneven", textbook=False)
def uneven_updates(d: Draw) -> Hidden:
    return Hidden(actuator=Hold(np.cumsum(d.between(0.3, 0.6) * d.slow_s * d.rng.uniform(0.3, 1.7, 4000))))


@form("static_nonlinearity", "power", textbook=True)
def power(d: Draw) -> Hidden:
    n = d.between(1.5, 2.2)
    return Hidden(actuator=Curve(lambda v: REST + (max(v, 0.1) ** n - REST**n) / (n * REST ** (n - 1.0))))


@form("static_nonlinearity", "S-shaped", textbook=False)
def s_shaped(d: Draw) -> Hidden:
    middle, width = REST + d.between(-0.4, 0.4) * d.swing, d.between(0.4, 0.8) * d.swing

    def f(v: float) -> float:
        return width * math.atan((v - middle) / width)

    return Hidden(actuator=Curve(lambda v: REST + f(v) - f(REST)), own_gain=True)


def kinked(ratio: float, at: float) -> Curve:
    def f(v: float) -> float:
        return (v - at) * (ratio if v > at else 1.0)

    return Curve(lambda v: REST + f(v) - f(REST))


@form("direction_gain", "kink", textbook=True)
def kink(d: Draw) -> Hidden:
    ratio = math.exp(d.either() * d.between(0.3, 0.8))
    return Hidden(actuator=kinked(ratio, REST), sizes={"ratio": ratio})


@form("direction_gain", "kink elsewhere", textbook=False)
def kink_elsewhere(d: Draw) -> Hidden:
    ratio, at = math.exp(d.either() * d.between(0.4, 0.9)), REST + d.between(-0.4, 0.4) * d.swing
    return Hidden(actuator=kinked(ratio, at), sizes={"ratio": ratio, "kink": at})


@form("direction_dynamics", "two lags", textbook=True)
def two_lags(d: Draw) -> Hidden:
    up_s = d.between(0.1, 0.3) * d.slow_s
    down_s = d.between(2.5, 5.0) * up_s
    return Hidden(actuator=Lags(up_s, down_s), sizes={"rising_lag_s": up_s, "falling_lag_s": down_s})


def bent(plant: Plant, change: Callable[[float], float]) -> Hidden:
    """Return the plant whose last state loses `x + change(x)` instead of `x`."""
    lags, K, linear = plant.lags, plant.K, plant.derivative

    def ringing(x: Sequence[float], v: float, t: float) -> Sequence[float]:
        speed, pull = linear(x, v, t)
        return [speed, pull - change(x[0]) / (lags[0] * lags[0])]

    def chained(x: Sequence[float], v: float, _t: float) -> Sequence[float]:
        sources = (K * v, *x[:-1])
        losses = (*x[:-1], x[-1] + change(x[-1]))
        return [(source - lost) / lag for source, lost, lag in zip(sources, losses, lags, strict=True)]

    return Hidden(plant=replace(plant, derivative=ringing if plant.kind == "ringing" else chained), loss=change)


@form("nonlinear_loss", "outflow", textbook=True)
def outflow(d: Draw) -> Hidden:
    level = d.between(1.6, 3.0) * abs(d.plant.K) * d.swing
    return bent(d.plant, lambda x: 2.0 * level * (math.sqrt(max(1.0 + x / level, 1e-4)) - 1.0) - x)


@form("nonlinear_loss", "radiation", textbook=True)
def radiation(d: Draw) -> Hidden:
    level = d.between(2.0, 4.0) * abs(d.plant.K) * d.swing
    return bent(d.plant, lambda x: level * ((1.0 + x / level) ** 4 - 1.0) / 4.0 - x)


@form("nonlinear_loss", "hardening", textbook=False)
def hardening(d: Draw) -> Hidden:
    width = d.between(0.5, 0.9) * abs(d.plant.K) * d.swing
    return bent(d.plant, lambda x: x**3 / width**2)


@form("nonlinear_loss", "exponential", textbook=False)
def exponential(d: Draw) -> Hidden:
    width = d.between(0.7, 1.5) * abs(d.plant.K) * d.swing
    return bent(d.plant, lambda x: width * math.expm1(min(x / width, 4.0)) - x)


def beside(plant: Plant, main: float, shares: Sequence[float], lags: Sequence[float]) -> Hidden:
    """Return the plant with `main` of its input, and further lags beside it."""
    linear, size, K = plant.derivative, plant.size, plant.K

    def f(x: Sequence[float], v: float, t: float) -> Sequence[float]:
        more = [(share * K * v - x[size + k]) / lag for k, (share, lag) in enumerate(zip(shares, lags, strict=True))]
        return [*linear(x[:size], v * main, t), *more]

    def measured(x: Sequence[float]) -> float:
        return plant.measured(x[:size]) + sum(x[size:])

    return Hidden(plant=replace(plant, derivative=f, size=size + len(lags), measured=measured))


@form("slow_mode", "one mode", textbook=True)
def soak(d: Draw) -> Hidden:
    share, slow_s = d.between(0.15, 0.4), d.between(5.0, 12.0) * d.slow_s
    hidden = beside(d.plant, 1.0 - share, [share], [slow_s])
    return replace(hidden, sizes={"share": share, "time_constant_s": slow_s})


@form("slow_mode", "spread", textbook=False)
def spread_soak(d: Draw) -> Hidden:
    share, slow = d.between(0.25, 0.5), d.between(4.0, 8.0) * d.slow_s
    return beside(d.plant, 1.0 - share, [share / 3.0] * 3, [slow * q for q in (1.0, 0.45, 0.15)])


@form("inverse_response", "two ways", textbook=True)
def two_ways(d: Draw) -> Hidden:
    share = d.between(0.3, 0.8)
    return beside(d.plant, 1.0 + share, [-share], [0.25 * d.slow_s])


@form("extra_lag", "four lags", textbook=True)
def four_lags(d: Draw) -> Hidden:
    T = d.plant.lags[0]
    lags = (T, d.between(0.6, 1.0) * T, d.between(0.4, 0.8) * T, d.between(0.3, 0.6) * T)
    return Hidden(plant=chain(d.plant.K, lags, d.plant.D, "fourth"))


def with_gain(plant: Plant, change: Callable[[float], float]) -> Hidden:
    linear: Derivative = plant.derivative
    return Hidden(plant=replace(plant, derivative=lambda x, v, t: linear(x, v * change(t), t)))


@form("gain_drift", "straight", textbook=True)
def straight_gain(d: Draw) -> Hidden:
    c, span = d.either() * d.between(0.25, 0.5), d.span_s
    per_h = 3600.0 * c / span
    return replace(with_gain(d.plant, lambda t: 1.0 + c * t / span), sizes={"relative_change_per_h": per_h})


@form("gain_drift", "fouling", textbook=False)
def fouling(d: Draw) -> Hidden:
    c, T = d.between(0.3, 0.5), d.between(0.2, 0.6) * d.span_s
    return with_gain(d.plant, lambda t: 1.0 + c * math.expm1(-t / T))


@form("gain_drift", "step", textbook=False)
def step_of_gain(d: Draw) -> Hidden:
    c, at = d.either() * d.between(0.25, 0.5), d.between(0.25, 0.6) * d.span_s
    jumping = with_gain(d.plant, lambda t: 1.0 if t < at else 1.0 + c)
    return replace(jumping, sizes={"relative_change": c, "at_s": at})


def loaded(d: Draw, f: Callable[[float], float]) -> Hidden:
    """Return a load of `f` of the time since it came, in lengths of the record."""
    c, at, span = d.either() * d.between(0.3, 0.7) * d.swing, d.between(0.2, 0.6) * d.span_s, d.span_s
    load = lambda t: c * f((t - at) / span) if t >= at else 0.0  # noqa: E731
    return Hidden(load=load, sizes={"size": c, "at_s": at})


@form("load_step", "step", textbook=True)
def load_step(d: Draw) -> Hidden:
    return loaded(d, lambda _since: 1.0)


@form("load_step", "ramp and stay", textbook=False)
def load_ramp(d: Draw) -> Hidden:
    return loaded(d, lambda since: min(since / 0.12, 1.0))


@form("load_step", "settling", textbook=False)
def load_that_settles(d: Draw) -> Hidden:
    return loaded(d, lambda since: -math.expm1(-since / 0.06))


@form("load_step", "pulse", textbook=False)
def load_pulse(d: Draw) -> Hidden:
    return loaded(d, lambda since: float(since < 0.2))


@form("drift", "straight", textbook=True)
def straight_drift(d: Draw) -> Hidden:
    c, span = d.either() * d.between(0.15, 0.5) * d.motion, d.span_s
    return Hidden(offset=lambda t: c * t / span, sizes={"pv_per_s": c / span})


@form("drift", "curved", textbook=False)
def curved_drift(d: Draw) -> Hidden:
    c, n, span = d.either() * d.between(0.3, 0.6) * d.motion, d.between(2.0, 3.0), d.span_s
    return Hidden(offset=lambda t: c * (t / span) ** n)


@form("ambient", "slow wave", textbook=True)
def slow_wave(d: Draw) -> Hidden:
    c, w, at = d.between(0.25, 0.5) * d.swing, 2.0 * math.pi * d.between(0.6, 1.6) / d.span_s, d.between(0.0, 6.28)
    return Hidden(load=lambda t: c * math.sin(w * t + at))


@form("ambient", "free", textbook=False)
def free_load(d: Draw) -> Hidden:
    values = np.cumsum(d.rng.standard_normal(7))
    values = (values - values[0]) * d.between(0.4, 0.9) * d.swing / max(float(np.ptp(values)), 1e-9)
    spline = scipy.interpolate.CubicSpline(np.linspace(0.0, d.span_s, 7), values, bc_type="natural")
    table, per_s = spline(np.linspace(0.0, d.span_s, 2001)), 2000.0 / d.span_s
    return Hidden(load=lambda t: float(table[min(max(int(per_s * t), 0), 2000)]))


def wave(d: Draw, shape: Callable[[float], float], size: Callable[[float], float]) -> Hidden:
    """Return an offset of a shape of the phase and a size of the share of the record."""
    c, n, q, span = d.between(0.15, 0.4) * d.motion, d.between(6.0, 25.0), d.between(0.0, 1.0), d.span_s
    sizes = {"period_s": span / n}
    return Hidden(offset=lambda t: c * size(t / span) * shape((n * t / span + q) % 1.0), sizes=sizes)


def sine(phase: float) -> float:
    return math.sin(2.0 * math.pi * phase)


@form("periodic_disturbance", "sine", textbook=True)
def sine_wave(d: Draw) -> Hidden:
    return wave(d, sine, lambda _share: 1.0)


@form("periodic_disturbance", "sawtooth", textbook=False)
def sawtooth(d: Draw) -> Hidden:
    return wave(d, lambda phase: 2.0 * phase - 1.0, lambda _share: 1.0)


@form("periodic_disturbance", "begins", textbook=False)
def wave_that_begins(d: Draw) -> Hidden:
    at = d.between(0.2, 0.5)
    return wave(d, sine, lambda share: float(share >= at))


@form("periodic_disturbance", "grows", textbook=False)
def wave_that_grows(d: Draw) -> Hidden:
    return wave(d, sine, lambda share: 1.6 * share)


@form("bias_step", "jump", textbook=True)
def jump(d: Draw) -> Hidden:
    c, at = d.either() * d.between(0.15, 0.5) * d.motion, d.between(0.2, 0.65) * d.span_s
    return Hidden(offset=lambda t: c if t >= at else 0.0, sizes={"size": c, "at_s": at})


@form("bias_step", "there and back", textbook=False)
def there_and_back(d: Draw) -> Hidden:
    c, at, span = d.either() * d.between(0.15, 0.5) * d.motion, d.between(0.2, 0.4) * d.span_s, d.span_s
    sizes = {"size": c, "at_s": at, "lasts_s": 0.25 * span}
    return Hidden(offset=lambda t: c if at <= t < at + 0.25 * span else 0.0, sizes=sizes)


@form("sensor_quantisation", "rounded", textbook=True)
def rounded(d: Draw) -> Hidden:
    step = d.between(0.06, 0.15) * d.motion
    return Hidden(sensor=lambda y, _rng: step * np.round(y / step))


@form("sensor_quantisation", "on change", textbook=False)
def on_change(d: Draw) -> Hidden:
    step = d.between(0.06, 0.15) * d.motion

    def f(y: Array, _rng: np.random.Generator) -> Array:
        last, out = float(y[0]), []
        for value in y.tolist():
            last = value if abs(value - last) >= step else last
            out.append(last)
        return np.array(out)

    return Hidden(sensor=f)


@form("outliers", "single", textbook=True)
def single_spikes(d: Draw) -> Hidden:
    def f(y: Array, rng: np.random.Generator) -> Array:
        off = rng.choice([-1.0, 1.0], y.size) * rng.uniform(0.3, 1.0, y.size) * d.motion
        return np.where(rng.random(y.size) < 0.015, y + off, y)

    return Hidden(sensor=f)


@form("outliers", "bursts", textbook=False)
def bursts(d: Draw) -> Hidden:
    def f(y: Array, rng: np.random.Generator) -> Array:
        out = y.copy()
        for k in rng.integers(10, y.size - 10, 6):
            out[k : k + 3] += rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 1.0) * d.motion
        return out

    return Hidden(sensor=f)


@form("timing_jitter", "uniform", textbook=True)
def jitter(_d: Draw) -> Hidden:
    return Hidden(jitter_samples=1.6)


@form("flow_delay", "pipe", textbook=True)
def pipe(d: Draw) -> Hidden:
    c = d.between(0.35, 0.6) / d.swing
    return replace(piped(d.plant, d.plant.D, lambda v, _t: 1.0 + c * v), sizes={"flow_per_output": c})


@form("flow_delay", "pipe behind a curve", textbook=False)
def pipe_behind_a_curve(d: Draw) -> Hidden:
    n, share = d.between(1.5, 2.5), d.between(0.6, 0.9)
    pipe = piped(d.plant, share * d.plant.D, lambda v, _t: max(1.0 + v / REST, 0.0) ** n)
    return replace(pipe, sizes={"power": n, "share_of_dead_time": share})


@form("dead_time_jump", "at once", textbook=True)
def flow_that_changes(d: Draw) -> Hidden:
    r, at = d.between(1.6, 2.6) ** d.either(), d.between(0.2, 0.5) * d.span_s
    plain = piped(d.plant, d.plant.D, lambda _v, t: 1.0 / r if t >= at else 1.0)
    return replace(plain, sizes={"later_over_first": r, "at_s": at})


@form("dead_time_jump", "within a while", textbook=False)
def flow_that_fades(d: Draw) -> Hidden:
    r, at, lasts = d.between(1.8, 2.8), d.between(0.2, 0.4) * d.span_s, 0.1 * d.span_s
    return piped(d.plant, d.plant.D, lambda _v, t: 1.0 / (1.0 + (r - 1.0) * min(max((t - at) / lasts, 0.0), 1.0)))


@form("time_proportioning", "latched", textbook=True)
def latched_pulses(d: Draw) -> Hidden:
    every = d.between(0.3, 0.8) * d.slow_s
    return Hidden(actuator=Switch(every, latched=True), sizes={"period_s": every})


@form("time_proportioning", "carrier", textbook=False)
def pulses_by_a_carrier(d: Draw) -> Hidden:
    return Hidden(actuator=Switch(d.between(0.3, 0.6) * d.slow_s, latched=False))


@form("sensor_hysteresis", "play", textbook=True)
def play_of_the_sensor(d: Draw) -> Hidden:
    w = d.between(0.1, 0.3) * d.motion
    return Hidden(gauge=gauge(w, 0.0), sizes={"width": w})


@form("sensor_hysteresis", "creeping", textbook=False)
def play_that_creeps(d: Draw) -> Hidden:
    return Hidden(gauge=gauge(d.between(0.15, 0.35) * d.motion, d.between(0.005, 0.02)))


def gauge(width: float, creep: float) -> Callable[[float], float]:
    """Return a reading with play about the PV, within which it creeps by a share of the way each sample."""
    last = 0.0

    def f(pv: float) -> float:
        nonlocal last
        last = max(pv - width / 2.0, min(pv + width / 2.0, last + creep * (pv - last)))
        return last

    return f


def piped(plant: Plant, volume: float, flow: Callable[[float, float], float]) -> Hidden:
    """Return the plant with a part of its dead time in a pipe, whose flow stays above an eighth of that at rest."""
    rest = replace(plant, D=plant.D - volume)
    return Hidden(plant=rest, pipe=Pipe(volume, lambda v, t: max(flow(v, t), 0.125)))


@form("nonlinear_loss", "reaction", textbook=False)
def reaction(d: Draw) -> Hidden:
    """Return the plant whose last state is heated by itself, by a factor e more with every `width` above the rest."""
    width, share = d.between(1.5, 2.5) * abs(d.plant.K) * d.swing, d.between(0.1, 0.22)
    hidden = bent(d.plant, lambda x: -share * width * math.expm1(min(x / width, 2.0)))
    sizes = {"heat_share": share, "growth_per_pv": 1.0 / width}
    return replace(hidden, plant=replace(hidden.plant or d.plant, K=d.plant.K / (1.0 - share)), sizes=sizes)


def returning(plant: Plant, share: float, later_s: float, tank_s: float = 0.0) -> Plant:
    """Return a plant to whose input a share of its output comes back a while later, through a tank where it has one."""
    linear, measured, K, size = plant.derivative, plant.measured, plant.K, plant.size
    times, past = [0.0], [0.0]

    def f(x: Sequence[float], v: float, t: float) -> Sequence[float]:
        pv = measured(x[:size])
        left = x[size] if tank_s else pv
        if t > times[-1]:
            times.append(t)
            past.append(left)
        k = bisect.bisect_right(times, t - later_s)
        back = 0.0
        if 0 < k < len(times):
            back = past[k - 1] + (past[k] - past[k - 1]) * (t - later_s - times[k - 1]) / (times[k] - times[k - 1])
        moved = linear(x[:size], v + share * back / K, t)
        return [*moved, (pv - left) / tank_s] if tank_s else moved

    whole = K / (1.0 - share)
    return replace(plant, K=whole, derivative=f, size=size + (tank_s > 0.0), measured=lambda x: measured(x[:size]))


@form("recycle", "pipe", textbook=True)
def recycle(d: Draw) -> Hidden:
    share, later_s = d.between(0.3, 0.6), d.between(0.8, 2.0) * d.slow_s
    return Hidden(plant=returning(d.plant, share, later_s), sizes={"share": share, "return_time_s": later_s})


@form("recycle", "pipe and tank", textbook=False)
def recycle_with_a_tank(d: Draw) -> Hidden:
    share, later_s = d.between(0.3, 0.6), d.between(0.8, 2.0) * d.slow_s
    return Hidden(plant=returning(d.plant, share, 0.7 * later_s, 0.3 * later_s))


ALIKE: dict[str, frozenset[str]] = {
    "saturation:tanh": frozenset({"static_nonlinearity"}),
    "saturation:rounded knee": frozenset({"static_nonlinearity", "direction_gain"}),
    "static_nonlinearity:S-shaped": frozenset({"saturation", "direction_gain"}),
    "static_nonlinearity:power": frozenset({"direction_gain"}),
    "direction_gain:kink elsewhere": frozenset({"static_nonlinearity"}),
    "direction_gain:kink": frozenset({"static_nonlinearity"}),
    "saturation:hard": frozenset({"direction_gain"}),
    "load_step:ramp and stay": frozenset({"drift", "ambient"}),
    "load_step:settling": frozenset({"drift", "ambient"}),
    "load_step:pulse": frozenset({"ambient"}),
    "ambient:slow wave": frozenset({"drift", "periodic_disturbance", "load_step"}),
    "ambient:free": frozenset({"drift"}),
    "drift:curved": frozenset({"ambient"}),
    "drift:straight": frozenset({"ambient"}),
    "gain_drift:step": frozenset(),
    "backlash:compliant": frozenset({"stiction"}),
    "stiction:mass and Coulomb": frozenset({"backlash"}),
    "rate_limit:soft": frozenset({"direction_dynamics"}),
    "rate_limit:unequal": frozenset({"direction_dynamics"}),
    "bias_step:there and back": frozenset(),
    "nonlinear_loss:hardening": frozenset({"nonlinear_stiffness"}),
    "nonlinear_loss:exponential": frozenset({"nonlinear_stiffness"}),
    "nonlinear_loss:reaction": frozenset({"nonlinear_stiffness"}),
}
"""Other right names of a form, because it is both."""


PAIRS = (
    ("backlash:play", "load_step:step"),
    ("backlash:play", "drift:straight"),
    ("backlash:play", "ambient:slow wave"),
    ("backlash:play", "gain_drift:step"),
    ("backlash:play", "nonlinear_loss:outflow"),
    ("backlash:play", "outliers:single"),
    ("stiction:stick and slip", "bias_step:jump"),
    ("stiction:stick and slip", "drift:straight"),
    ("saturation:hard", "drift:straight"),
    ("saturation:hard", "load_step:step"),
    ("saturation:hard", "gain_drift:straight"),
    ("saturation:hard", "periodic_disturbance:sine"),
    ("saturation:hard", "sensor_quantisation:rounded"),
    ("rate_limit:equal", "load_step:step"),
    ("output_quantisation:even", "drift:straight"),
    ("static_nonlinearity:power", "load_step:step"),
    ("direction_gain:kink", "bias_step:jump"),
    ("direction_gain:kink elsewhere", "drift:curved"),
    ("direction_dynamics:two lags", "load_step:step"),
    ("nonlinear_loss:radiation", "load_step:step"),
    ("slow_mode:one mode", "load_step:step"),
    ("inverse_response:two ways", "drift:straight"),
    ("flow_delay:pipe", "drift:straight"),
    ("load_step:step", "bias_step:jump"),
    ("load_step:step", "periodic_disturbance:sine"),
)
"""Forms that act at different places, or add up."""


def together(first: Hidden, second: Hidden) -> Hidden:
    """Return two effects at once, of which one at most changes the actuator, and one the process."""
    moving = second if isinstance(first.actuator, Straight) else first
    process = second if first.plant is None else first
    sensors = [hidden.sensor for hidden in (first, second) if hidden.sensor is not None]

    def sensed(y: Array, rng: np.random.Generator) -> Array:
        for sensor in sensors:
            y = sensor(y, rng)
        return y

    return Hidden(
        actuator=moving.actuator,
        load=lambda t: first.load(t) + second.load(t),
        offset=lambda t: first.offset(t) + second.offset(t),
        plant=process.plant,
        loss=process.loss,
        pipe=process.pipe,
        sensor=sensed if sensors else None,
        jitter_samples=max(first.jitter_samples, second.jitter_samples),
        own_gain=first.own_gain or second.own_gain,
    )
