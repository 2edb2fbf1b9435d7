"""Plants drawn by seed, and recordings of experiments on them: the product's own tuning experiment, and others.

A scene is a plant with the figures of its undisturbed experiment, in which hidden physics is measured: relay amplitude
`h` and levels, standard deviation of the PV while the relay runs, period, times. Every draw follows from the seed.
"""

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.recording import Recording, Sample
from autotuner_sim import Fopdt, Noise, SopdtOverdamped, SopdtUnderdamped, SteppedPlant

OUTPUT0, PV0, H = 40.0, 80.0, 10.0
KINDS = ("lag", "balanced", "delay", "underdamped")
THESIS = ((1.0, 10.0, 2.0), (1.65, 20.0, 10.0), (8.1, 9.4, 5.2))
"""K, T, D of the first-order plants in the tables 2.1, 5.2 and 5.3 of the thesis."""
PER_PERIOD = 60
MOST_SAMPLES = 4000


@dataclass(frozen=True)
class Physics:
    """What is hidden around a plant; the lists are those of `SteppedPlant`."""

    plant: object = None
    actuators: tuple = ()
    loads: tuple = ()
    offsets: tuple = ()
    sensors: tuple = ()
    couplings: tuple = ()
    bounds: tuple = ()
    transport: object = None
    clock: object = None
    columns: dict = field(default_factory=dict)
    begins_s: float | None = None
    """The recording is cut to begin here, s."""

    def __add__(self, other):
        """Both at once."""
        joined = {
            name: getattr(self, name) + getattr(other, name)
            for name in ("actuators", "loads", "offsets", "sensors", "couplings", "bounds")
        }
        either = {name: getattr(self, name) or getattr(other, name) for name in ("plant", "transport", "clock")}
        begins = other.begins_s if self.begins_s is None else self.begins_s
        return Physics(**joined, **either, columns=self.columns | other.columns, begins_s=begins)


NOTHING = Physics()


@dataclass(frozen=True)
class Scene:
    """A plant and the figures of its undisturbed tuning experiment; times in s, `spread` and `reach` in PV units."""

    kind: str
    plant: object
    dt: float
    period_s: float
    relay_s: float
    end_s: float
    spread: float
    amplitude: float
    reach: float

    @property
    def lag_s(self):
        """The plant's lag: T, T1 + T2 or n."""
        return lag_of(self.plant)

    @property
    def span_s(self):
        """From the start of the relay to the end."""
        return self.end_s - self.relay_s


def lag_of(plant):
    """Return the sum of the lags of one of ours, of the tuner's or of a mapping, s."""
    value = plant.get if isinstance(plant, dict) else lambda name: getattr(plant, name, None)
    if value("T") is not None:
        return value("T")
    return value("T1") + value("T2") if value("T1") is not None else value("n")


def draw_plant(kind, rng):
    """Return a plant of that kind, never twice the same."""
    K, T = rng.uniform(0.6, 3.5), 10.0 ** rng.uniform(0.5, 2.0)
    if kind == "thesis":
        return Fopdt(*THESIS[int(rng.integers(len(THESIS)))])
    if kind == "lag":
        return Fopdt(K, T, T * rng.uniform(0.08, 0.2))
    if kind == "balanced":
        return Fopdt(K, T, T * rng.uniform(0.6, 1.2))
    if kind == "delay":
        return Fopdt(K, T, T * rng.uniform(2.5, 5.0))
    if kind == "overdamped":
        return SopdtOverdamped(K, T, T * rng.uniform(0.3, 0.7), T * rng.uniform(0.2, 0.6))
    return SopdtUnderdamped(K, T * T, 2.0 * rng.uniform(0.3, 0.55) * T, T * rng.uniform(0.4, 1.0))


@lru_cache(maxsize=512)
def scene(kind, seed):
    """Return the scene of a plant."""
    plant = draw_plant(kind, np.random.default_rng([seed, (*KINDS, "thesis").index(kind)]))
    scale = plant.D + 0.5 * min(lag_of(plant), 8.0 * plant.D)
    rough = Scene(kind, plant, scale / 10.0, math.nan, math.nan, math.nan, math.nan, math.nan, math.nan)
    period_s = _figures(rough).period_s
    return _figures(replace(rough, dt=period_s / PER_PERIOD))


def _figures(rough):
    recording = tuning(rough, NOTHING, 0.0, 0)
    segments = recording.settings["segments"]
    relay_s, end_s = segments["relay"], float(recording.t[-1])
    oscillating = recording.window(relay_s, segments.get("staircase", end_s))
    rises = oscillating.t[1:][np.diff(oscillating.output) > 0.0]
    full = oscillating.output.max() - oscillating.output.min()
    rises = rises[: max(2, int(np.sum(np.diff(oscillating.output) > 0.9 * full)))]
    pv = oscillating.pv
    late = pv[pv.size // 3 : 2 * pv.size // 3]
    return replace(
        rough,
        period_s=float(np.median(np.diff(rises))),
        relay_s=relay_s,
        end_s=end_s,
        spread=float(late.std()),
        amplitude=float(np.ptp(late)) / 2.0,
        reach=float(recording.pv.max() - PV0),
    )


class Loop:
    """A plant with its hidden physics, sampled; remembers what it was given."""

    def __init__(self, scene, physics, sigma, seed, noise=None):
        fine_s = scene.dt / 5.0
        moving = any(actuator.moves_by_itself for actuator in physics.actuators)
        sensors = [noise] if noise is not None else ([Noise(sigma, seed)] if sigma > 0.0 else [])
        self.plant = SteppedPlant(
            physics.plant or scene.plant,
            output0=OUTPUT0,
            pv0=PV0,
            start_s=-30.0 * (lag_of(scene.plant) + scene.plant.D) if physics.begins_s is not None else 0.0,
            output_limits=(0.0, 100.0),
            actuators=physics.actuators,
            loads=physics.loads,
            offsets=physics.offsets,
            sensors=(*sensors, *physics.sensors),
            actuator_scan_s=fine_s if moving else None,
            couplings=physics.couplings,
            bounds=physics.bounds,
            step_s=fine_s if physics.couplings or physics.bounds else None,
            transport=physics.transport,
        )
        self.dt, self.clock, self.samples = scene.dt, physics.clock, []

    @property
    def t(self):
        return len(self.samples) * self.dt

    def sample(self):
        t = self.t
        self.plant.advance(t if self.clock is None else self.clock.moment(t))
        return Sample(t, self.plant.measure(), self.plant.output)

    def hold(self, sample, output):
        self.plant.output = output
        self.samples.append(replace(sample, output=output))

    def recording(self, physics, settings):
        whole = Recording.from_samples(self.samples, settings)
        extra = {name: np.array([signal.signal(t) for t in whole.t]) for name, signal in physics.columns.items()}
        whole = Recording(whole.t, whole.output, whole.pv, whole.set_point, extra, whole.settings)
        return whole if physics.begins_s is None else whole.window(physics.begins_s, math.inf)


class RefusedError(Exception):
    """The experiment was refused; its code."""


def tuning(scene, physics, sigma, seed, noise=None, *, check=True):
    """Return the recording of the product's own experiment."""
    loop = Loop(scene, physics, sigma, seed, noise)
    settings = ExperimentSettings(sample_time_s=scene.dt, amplitude=H, check=check, limits=Limits(output=(0.0, 100.0)))
    run = Experiment(settings, OUTPUT0)
    while run.phase is not Phase.RESTORE and len(loop.samples) < MOST_SAMPLES:
        sample = loop.sample()
        command = run.step(sample)
        if run.phase is not Phase.RESTORE:
            loop.hold(sample, command.output)
    if run.verdict is not None or "relay" not in run.segments:
        raise RefusedError(run.verdict.code if run.verdict else "too long")
    return loop.recording(physics, run.settings_so_far())


def relay_only(scene, physics, sigma, seed, noise=None):
    """Return the recording without the check."""
    return tuning(scene, physics, sigma, seed, noise, check=False)


def steps(scene, physics, sigma, seed, noise=None):
    """Return a recording of open-loop steps, each held until it has settled."""
    loop = Loop(scene, physics, sigma, seed, noise)
    hold_s = scene.plant.D + 4.0 * lag_of(scene.plant)
    for part in (0.0, 1.0, 0.3, -0.6, 0.0, 0.5):
        ends_s = loop.t + (hold_s if part else max(hold_s, 50 * scene.dt))
        while loop.t < ends_s:
            loop.hold(loop.sample(), OUTPUT0 + part * H)
    return loop.recording(physics, {})


def closed_loop(scene, physics, sigma, seed, noise=None):
    """Return a recording of set-point steps under a PI controller with lambda = D + T/2."""
    loop = Loop(scene, physics, sigma, seed, noise)
    plant, lag_s = scene.plant, lag_of(scene.plant)
    gain, rested = lag_s / (plant.K * (1.5 * plant.D + 0.5 * lag_s)), 50 * scene.dt
    gain *= 0.4 if scene.kind == "underdamped" else 1.0
    sum_s, hold_s = 0.0, 3.0 * (plant.D + lag_s)
    moves = (0.0, 1.0, 0.3, -0.6, 0.2)
    while loop.t < rested + hold_s * len(moves):
        sample = loop.sample()
        row = min(int(max(sample.t - rested, 0.0) / hold_s), len(moves) - 1)
        set_point = PV0 + 0.6 * plant.K * H * (moves[row] if sample.t >= rested else 0.0)
        error = set_point - sample.pv
        sum_s += error * scene.dt if sample.t >= rested else 0.0
        output = OUTPUT0 + gain * (error + sum_s / lag_s) if sample.t >= rested else OUTPUT0
        loop.hold(replace(sample, set_point=set_point), min(max(output, 0.0), 100.0))
    return loop.recording(physics, {})


EXPERIMENTS = {"tuning": tuning, "relay only": relay_only, "steps": steps, "closed loop": closed_loop}
