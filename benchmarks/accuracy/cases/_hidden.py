"""The table of hidden physics: every effect in the form of the textbooks and in others, in two severities.

A form makes `Physics` of a scene, a severity (0 or 1) and a random generator, and tells what is true: the names that
are right for it, the first being its own, and the sizes that a diagnosis can be held to, by the names and in the units
of the report. Sizes are set in what the undisturbed experiment shows: relay amplitude `H`, spread and amplitude of the
PV, period. A declared form comes with the model that its user believes in.
"""

# ruff: noqa: ARG001 - all makers have the same signature

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from autotuner.core.model import process
from autotuner_sim import (
    ActuatorHold,
    Backlash,
    BiasStep,
    ChoudhuryStiction,
    ConvectiveLoss,
    CurvedDrift,
    DirectionDynamics,
    DirectionGain,
    Drift,
    EqualPercentage,
    Fopdt,
    Fouling,
    Freeze,
    GainDrift,
    HeStiction,
    Integrating,
    Jitter,
    KanoStiction,
    LoadRamp,
    LoadStep,
    Measured,
    OutputQuantisation,
    Overflow,
    PeriodicLoad,
    PlugFlow,
    PositionBacklash,
    PowerLaw,
    Quantisation,
    Radiation,
    RateLimit,
    RationalPlant,
    Saturation,
    SendOnDelta,
    SoftRateLimit,
    SoftSaturation,
    SopdtUnderdamped,
    Spikes,
    SquareRootOutflow,
    Stiction,
    Thermostat,
    TimeProportioned,
    UnequalLag,
    UnequalWait,
    Weir,
)
from benchmarks.accuracy.cases._scenes import MOST_SAMPLES, OUTPUT0, H, Physics, lag_of


@dataclass(frozen=True)
class Truth:
    """What is hidden: right names (its own first), sizes by the names of the report, the model that was declared."""

    right: tuple
    sizes: dict = field(default_factory=dict)
    declared: object = None


@dataclass(frozen=True)
class Form:
    """One form of one effect."""

    effect: str
    label: str
    textbook: bool
    make: Callable
    kinds: tuple = ("lag", "balanced", "delay", "underdamped")


def form_of(effect, label, make, *, textbook=True, also=(), kinds=Form.kinds):
    """Make a form whose maker returns the physics, or the physics with sizes, or these with a declared model."""

    def complete(scene, severity, rng):
        made = make(scene, severity, rng)
        made = made if isinstance(made, tuple) else (made, {})
        physics, sizes, declared = made if len(made) == 3 else (*made, None)
        return physics, Truth((effect, *also), sizes, declared)

    return Form(effect, label, textbook, complete, kinds)


def _size(severity, small, large, rng):
    return (large if severity else small) * rng.uniform(0.85, 1.15)


def _sign(rng):
    return float(rng.choice([-1.0, 1.0]))


def _at(scene, rng, low=0.3, high=0.7):
    return scene.relay_s + rng.uniform(low, high) * scene.span_s


# --- actuator


def backlash(scene, severity, rng):
    width = _size(severity, 0.8, 2.4, rng)
    return Physics(actuators=(Backlash(width),)), {"width": width}


def uneven_backlash(scene, severity, rng):
    return Physics(actuators=(PositionBacklash(_size(severity, 0.9, 2.4, rng), 0.04 * _sign(rng)),))


def stenman(scene, severity, rng):
    band = _size(severity, 0.9, 2.2, rng)
    return Physics(actuators=(Stiction(band),)), {"band": band}


def he(scene, severity, rng):
    static = _size(severity, 0.9, 2.0, rng)
    return Physics(actuators=(HeStiction(static, rng.uniform(0.3, 0.7) * static),))


def kano(scene, severity, rng):
    S = _size(severity, 1.2, 3.0, rng)
    return Physics(actuators=(KanoStiction(S, rng.uniform(0.4, 0.8) * S),))


def choudhury(scene, severity, rng):
    S = _size(severity, 1.2, 3.0, rng)
    return Physics(actuators=(ChoudhuryStiction(S, rng.uniform(0.4, 0.8) * S),))


def saturation(scene, severity, rng):
    high = OUTPUT0 + 13.3 * _size(severity, 0.85, 0.6, rng)
    return Physics(actuators=(Saturation(0.0, high),)), {"high": high}


def soft_saturation(scene, severity, rng):
    high = OUTPUT0 + 13.3 * _size(severity, 0.85, 0.6, rng)
    return Physics(actuators=(SoftSaturation(high, rng.uniform(1.0, 2.5)),))


def rate_limit(scene, severity, rng):
    rate = 2.0 * H / (_size(severity, 0.12, 0.35, rng) * scene.period_s)
    return Physics(actuators=(RateLimit(rate),)), {"rate_per_s": rate}


def soft_rate_limit(scene, severity, rng):
    rate = 2.0 * H / (_size(severity, 0.12, 0.35, rng) * scene.period_s)
    return Physics(actuators=(SoftRateLimit(rate, rng.uniform(0.02, 0.05) * scene.period_s),))


def output_quantisation(scene, severity, rng):
    step = _size(severity, 0.9, 3.0, rng)
    return Physics(actuators=(OutputQuantisation(step),)), {"step": step}


def actuator_hold(scene, severity, rng):
    period_s = _size(severity, 0.08, 0.2, rng) * scene.period_s
    return Physics(actuators=(ActuatorHold(period_s),)), {"period_s": period_s}


def busy_hold(scene, severity, rng):
    seed = int(rng.integers(2**31))
    return Physics(actuators=(ActuatorHold(_size(severity, 0.08, 0.2, rng) * scene.period_s, 0.5, seed),))


def power_law(scene, severity, rng):
    return Physics(actuators=(PowerLaw(1.0 + _size(severity, 0.5, 1.5, rng)),))


def equal_percentage(scene, severity, rng):
    return Physics(actuators=(EqualPercentage(_size(severity, 8.0, 45.0, rng)),))


def direction_gain(scene, severity, rng):
    ratio = 1.0 + _size(severity, 0.25, 0.8, rng)
    return Physics(actuators=(DirectionGain(ratio),)), {"ratio": ratio}


def soft_direction_gain(scene, severity, rng):
    return Physics(actuators=(DirectionGain(1.0 + _size(severity, 0.25, 0.8, rng), rng.uniform(0.5, 1.5)),))


def direction_dynamics(scene, severity, rng):
    return Physics(couplings=(DirectionDynamics(1.0 + _size(severity, 0.4, 1.2, rng), scene.plant.K),))


def unequal_element(scene, severity, rng):
    down_s = _size(severity, 0.1, 0.25, rng) * scene.period_s
    return Physics(actuators=(UnequalLag(0.15 * down_s, down_s),))


def unequal_wait(scene, severity, rng):
    return Physics(actuators=(UnequalWait(_size(severity, 0.04, 0.1, rng) * scene.period_s),))


# --- process


def rational(plant):
    """Return the plant by its polynomials."""
    lags = (1.0, plant.n, plant.m) if isinstance(plant, SopdtUnderdamped) else (1.0, plant.T)
    return RationalPlant((plant.K,), lags, plant.D)


def believed(plant):
    """Return the plant as a model of the tuner."""
    if isinstance(plant, SopdtUnderdamped):
        return process.SopdtUnderdamped(plant.K, plant.m, plant.n, plant.D)
    return process.Fopdt(plant.K, plant.T, plant.D)


def extra_lag(scene, severity, rng):
    lag_s = _size(severity, 0.08, 0.2, rng) * scene.period_s
    plant = rational(scene.plant).times((1.0,), (1.0, lag_s))
    return Physics(plant=plant), {"time_constant_s": lag_s}, believed(scene.plant)


def spread_lag(scene, severity, rng):
    lag_s = _size(severity, 0.08, 0.2, rng) * scene.period_s / 3.0
    plant = rational(scene.plant)
    for _ in range(3):
        plant = plant.times((1.0,), (1.0, lag_s))
    return Physics(plant=plant), {}, believed(scene.plant)


def inverse_response(scene, severity, rng):
    zero_s = _size(severity, 0.05, 0.15, rng) * scene.period_s
    second_s = 0.0 if scene.kind == "underdamped" else 0.3 * scene.plant.T
    plant = rational(scene.plant).times((1.0, -zero_s), (1.0, second_s) if second_s else (1.0,))
    declared = believed(scene.plant)
    if second_s:
        declared = process.SopdtOverdamped(scene.plant.K, scene.plant.T, second_s, scene.plant.D)
    return Physics(plant=plant), {}, declared


def integrating(scene, severity, rng):
    plant = scene.plant
    return Physics(plant=Integrating(plant.K / plant.T, 0.0, plant.D)), {}, believed(plant)


def leaky(scene, severity, rng):
    plant, leak = scene.plant, _size(severity, 12.0, 30.0, rng)
    return Physics(plant=Fopdt(plant.K * leak, plant.T * leak, plant.D)), {}, believed(plant)


def slow_leaky(scene, severity, rng):
    plant, leak = scene.plant, _size(severity, 12.0, 30.0, rng)
    slow = RationalPlant((plant.K * leak,), (1.0, plant.T * leak), plant.D)
    return Physics(plant=slow.times((1.0,), (1.0, 0.05 * scene.period_s))), {}, believed(plant)


def slow_mode(scene, severity, rng):
    share, slow_s = _size(severity, 0.2, 0.45, rng), rng.uniform(0.35, 0.6) * scene.span_s
    plant, fast = scene.plant, rational(scene.plant)
    quick = RationalPlant(((1.0 - share) * plant.K,), fast.a, plant.D)
    sizes = {"share": share, "time_constant_s": slow_s}
    return Physics(plant=quick.beside((share * plant.K,), (1.0, slow_s))), sizes


def diffusion(scene, severity, rng):
    share, slow_s = _size(severity, 0.2, 0.45, rng), rng.uniform(0.35, 0.6) * scene.span_s
    plant, fast = scene.plant, rational(scene.plant)
    whole = RationalPlant(((1.0 - share) * plant.K,), fast.a, plant.D)
    for part, ratio in ((0.6, 1.0), (0.4, 0.35)):
        whole = whole.beside((part * share * plant.K,), (1.0, ratio * slow_s))
    return Physics(plant=whole)


def root_outflow(scene, severity, rng):
    return Physics(couplings=(SquareRootOutflow(scene.reach * _size(severity, 3.0, 1.4, rng), scene.plant.K),))


def radiation(scene, severity, rng):
    absolute = scene.reach * _size(severity, 7.0, 3.0, rng)
    return Physics(couplings=(Radiation(rng.uniform(0.7, 1.0), absolute, scene.plant.K),))


def convection(scene, severity, rng):
    excess = scene.reach * _size(severity, 1.6, 1.1, rng)
    return Physics(couplings=(ConvectiveLoss(excess, rng.uniform(1.25, 1.45), scene.plant.K),))


def overflow(scene, severity, rng):
    level = scene.reach * _size(severity, 0.8, 0.55, rng)
    bound = Overflow(level, slope=scene.kind == "underdamped")
    return Physics(bounds=(bound,)), {"limit_above_rest": level}


def weir(scene, severity, rng):
    level = scene.reach * _size(severity, 0.75, 0.5, rng)
    return Physics(couplings=(Weir(level, 8.0 / scene.reach**0.5, scene.plant.K),))


def flow_delay(scene, severity, rng):
    share = _size(severity, 0.25, 0.6, rng)
    return Physics(transport=PlugFlow(scene.plant.D, share, 13.3)), {"flow_per_output": share / 13.3}


def gain_drift(scene, severity, rng):
    change = _size(severity, 0.2, 0.5, rng) * _sign(rng)
    return Physics(couplings=(GainDrift(change / scene.span_s, scene.relay_s),))


def fouling(scene, severity, rng):
    return Physics(couplings=(Fouling(scene.span_s / _size(severity, 0.3, 0.9, rng), scene.relay_s),))


# --- disturbance


def load_step(scene, severity, rng):
    at_s, size = _at(scene, rng), _size(severity, 0.8, 2.5, rng) * _sign(rng)
    return Physics(loads=(LoadStep(at_s, size),)), {"at_s": at_s, "size": size}


def load_ramp(scene, severity, rng):
    size, over_s = _size(severity, 0.8, 2.5, rng) * _sign(rng), rng.uniform(0.08, 0.15) * scene.span_s
    return Physics(loads=(LoadRamp(_at(scene, rng), size, over_s),))


def drift(scene, severity, rng):
    rate = _size(severity, 0.6, 1.8, rng) * scene.spread * _sign(rng) / scene.span_s
    return Physics(offsets=(Drift(rate, scene.relay_s),)), {"pv_per_s": rate}


def curved_drift(scene, severity, rng):
    size = _size(severity, 0.6, 1.8, rng) * scene.spread * _sign(rng)
    return Physics(offsets=(CurvedDrift(size, rng.uniform(0.3, 0.6) * scene.span_s, scene.relay_s),))


def _periodic(shape):
    def make(scene, severity, rng):
        periods = rng.uniform(0.37, 0.61) if rng.random() < 0.5 else rng.uniform(1.7, 3.5)
        period_s, amplitude = periods * scene.period_s, _size(severity, 0.7, 2.0, rng)
        amplitude *= 1.0 if periods > 1.0 else 1.6
        load = PeriodicLoad(amplitude, period_s, shape, rng.uniform(0.0, period_s))
        return Physics(loads=(load,)), {"period_s": period_s}

    return make


def _column(name, signal, lag):
    def make(scene, severity, rng):
        # As long as a record can become: where the table ends, its answer would stand still half-way.
        t = np.arange(0.0, max(3.0 * scene.end_s, (MOST_SAMPLES + 2) * scene.dt), scene.dt)
        d = signal(t, scene, rng)
        gain = _size(severity, 0.4, 1.2, rng) * scene.spread * _sign(rng) / float(np.std(d))
        lag_s = lag * lag_of(scene.plant)
        measured = Measured(t, d, gain, lag_s)
        return Physics(offsets=(measured,), columns={name: measured}), {"gain": gain, "lag_s": lag_s}

    return make


def slow_weather(t, scene, rng):
    turns = np.maximum(t - scene.relay_s - scene.period_s, 0.0) / scene.span_s
    return 20.0 + 2.0 * np.sin(2.0 * np.pi * rng.uniform(1.2, 2.2) * turns) + rng.uniform(-2.0, 2.0) * turns


def feed_steps(t, scene, rng):
    levels = rng.uniform(-1.0, 1.0, 200)
    moments = scene.relay_s + np.cumsum(rng.uniform(0.4, 1.4, 200)) * scene.period_s
    levels[0] = 0.0
    return 50.0 + 5.0 * levels[np.searchsorted(moments, t)]


# --- sensor


def quantisation(scene, severity, rng):
    step = _size(severity, 0.35, 1.0, rng) * scene.spread
    return Physics(sensors=(Quantisation(step),)), {"step": step}


def send_on_delta(scene, severity, rng):
    return Physics(sensors=(SendOnDelta(_size(severity, 0.3, 0.8, rng) * scene.spread),))


def bias_step(scene, severity, rng):
    at_s, size = _at(scene, rng), _size(severity, 0.5, 1.5, rng) * scene.spread * _sign(rng)
    return Physics(offsets=(BiasStep(at_s, size),)), {"at_s": at_s, "size": size}


def spikes(scene, severity, rng):
    size, seed = _size(severity, 2.0, 5.0, rng) * scene.spread, int(rng.integers(2**31))
    return Physics(sensors=(Spikes(size, 0.015, 1, seed, scene.relay_s + 1.5 * scene.period_s),))


def bursts(scene, severity, rng):
    size, seed = _size(severity, 2.0, 5.0, rng) * scene.spread, int(rng.integers(2**31))
    return Physics(sensors=(Spikes(size, 0.006, 4, seed, scene.relay_s + 1.5 * scene.period_s),))


def jitter(scene, severity, rng):
    return Physics(clock=Jitter(min(_size(severity, 0.5, 0.95, rng), 0.98) * scene.dt, int(rng.integers(2**31))))


def jitter_in_runs(scene, severity, rng):
    return Physics(clock=Jitter(min(_size(severity, 0.5, 0.95, rng), 0.98) * scene.dt, int(rng.integers(2**31)), 6))


def not_settled(scene, severity, rng):
    size = _size(severity, 1.0, 3.0, rng) * _sign(rng)
    before = LoadStep(-np.inf, size), LoadStep(scene.relay_s - scene.dt, -size)
    return Physics(loads=before, begins_s=scene.relay_s)


def time_proportioned(scene, severity, rng):
    return Physics(actuators=(TimeProportioned(_size(severity, 0.05, 0.15, rng) * scene.lag_s),))


# --- outside of any catalogue


def neighbour(scene, severity, rng):
    tau_s, power = 1.5 * scene.period_s, 10.0
    push = _size(severity, 0.7, 1.6, rng) / 2.0
    pull = rng.uniform(0.1, 0.3) * 2.0 / scene.spread
    return Physics(couplings=(Thermostat(tau_s, power, 2.0, pull, push, scene.relay_s),))


def freeze(scene, severity, rng):
    return Physics(sensors=(Freeze(_at(scene, rng, 0.2, 0.6), _size(severity, 0.4, 1.2, rng) * scene.period_s),))


ONE_LAG = ("lag", "balanced", "delay")
FORMS = (
    form_of("backlash", "play", backlash),
    form_of("backlash", "uneven play", uneven_backlash, textbook=False),
    form_of("stiction", "Stenman", stenman),
    form_of("stiction", "He", he, textbook=False),
    form_of("stiction", "Kano", kano),
    form_of("stiction", "Choudhury", choudhury, textbook=False),
    form_of("saturation", "hard", saturation),
    form_of("saturation", "soft", soft_saturation, textbook=False, also=("static_nonlinearity",)),
    form_of("rate_limit", "hard", rate_limit),
    form_of("rate_limit", "soft", soft_rate_limit, textbook=False),
    form_of("output_quantisation", "rounded", output_quantisation),
    form_of("actuator_hold", "even", actuator_hold),
    form_of("actuator_hold", "busy", busy_hold, textbook=False),
    form_of("static_nonlinearity", "power law", power_law),
    form_of("static_nonlinearity", "equal percentage", equal_percentage, textbook=False),
    form_of("direction_gain", "kink", direction_gain),
    form_of("direction_gain", "bend", soft_direction_gain, textbook=False, also=("static_nonlinearity",)),
    form_of("direction_dynamics", "process", direction_dynamics, kinds=ONE_LAG),
    form_of("direction_dynamics", "element", unequal_element),
    form_of("direction_dynamics", "wait", unequal_wait, textbook=False),
    form_of("extra_lag", "one", extra_lag),
    form_of("extra_lag", "spread", spread_lag, textbook=False),
    form_of("inverse_response", "zero", inverse_response),
    form_of("integrating", "pure", integrating, kinds=("lag", "balanced")),
    form_of("integrating", "leaky", leaky, kinds=("lag", "balanced")),
    form_of(
        "integrating", "leaky and lagged", slow_leaky, textbook=False, also=("extra_lag",), kinds=("lag", "balanced")
    ),
    form_of("slow_mode", "one slow mode", slow_mode),
    form_of("slow_mode", "diffusion", diffusion, textbook=False),
    form_of("nonlinear_loss", "square root", root_outflow),
    form_of("nonlinear_loss", "radiation", radiation),
    form_of("nonlinear_loss", "convection", convection, textbook=False),
    form_of("state_saturation", "full", overflow),
    form_of("state_saturation", "weir", weir, textbook=False, also=("nonlinear_loss",)),
    form_of("flow_delay", "plug flow", flow_delay),
    form_of("gain_drift", "linear", gain_drift),
    form_of("gain_drift", "fouling", fouling, textbook=False),
    form_of("load_step", "step", load_step),
    form_of("load_step", "ramp", load_ramp, textbook=False, also=("drift",)),
    form_of("drift", "linear", drift),
    form_of("drift", "curved", curved_drift, textbook=False),
    form_of("periodic_disturbance", "sine", _periodic("sine")),
    form_of("periodic_disturbance", "triangle", _periodic("triangle"), textbook=False),
    form_of("periodic_disturbance", "square", _periodic("square"), textbook=False),
    form_of("ambient", "weather", _column("ambient", slow_weather, 0.5), also=("measured_disturbance",)),
    form_of("measured_disturbance", "feed", _column("feed", feed_steps, 0.5)),
    form_of("sensor_quantisation", "rounded", quantisation),
    form_of("sensor_quantisation", "send on delta", send_on_delta, textbook=False),
    form_of("bias_step", "step", bias_step),
    form_of("outliers", "spikes", spikes),
    form_of("outliers", "bursts", bursts, textbook=False),
    form_of("timing_jitter", "even", jitter),
    form_of("timing_jitter", "in runs", jitter_in_runs, textbook=False),
    form_of("not_settled", "disturbed before", not_settled, also=("load_step",)),
    form_of(
        "time_proportioning",
        "relay heater",
        time_proportioned,
        also=("periodic_disturbance", "actuator_hold"),
        kinds=("lag", "balanced", "underdamped"),
    ),
)
OUTSIDE = (
    form_of("neighbour", "thermostat", neighbour, textbook=False, also=("periodic_disturbance",)),
    form_of("freeze", "frozen sensor", freeze, textbook=False, also=("outliers",)),
)
PAIRS = (
    ("backlash", "load_step"),
    ("stiction", "drift"),
    ("saturation", "periodic_disturbance"),
    ("static_nonlinearity", "bias_step"),
    ("rate_limit", "load_step"),
    ("direction_gain", "drift"),
    ("backlash", "outliers"),
    ("backlash", "slow_mode"),
    ("nonlinear_loss", "load_step"),
    ("output_quantisation", "measured_disturbance"),
    ("stiction", "bias_step"),
    ("gain_drift", "periodic_disturbance"),
)


def textbook_form(effect):
    """Return the first form of an effect."""
    return next(form for form in FORMS if form.effect == effect)
