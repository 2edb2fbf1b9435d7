"""Fault injection: the whole runtime on simulated plants in virtual time, while everything goes wrong that can.

    python benchmarks/safety/faults.py [--runs 2200] [--jobs 2] [--kind "PV frozen"] [--seed 7]

Every run draws a plant of the batch, noise, a load, mode, slew limit, safe output, PV limits and the moment of the
fault. Required of every run, exit code 1 otherwise:

    verdict     it ends with one
    safe        output and mode end as they were found (or at the declared safe output, or with whoever took over);
                while the link is dead the end is `output_unknown`, and the next start makes it good
    in time     not later than its time limit, and the restore after it
    within      no write beyond limits or slew
    withdrawn   once the true PV is beyond its limit, the output is withdrawn within what the fault makes possible

The last is also printed in PV: how far the PV was beyond its limit when the output was withdrawn (`driven`), and how
far it went by itself afterwards (`after`), both in amplitudes of the plant's oscillation.

`kill -9` is real: the run is a process of its own, which kills itself; the plant goes on in its parent, where the next
start finds the journal.
"""

import argparse
import asyncio
import collections
import contextlib
import logging
import math
import os
import pickle
import signal
import sys
import tempfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import async_solipsism
import joblib
import numpy as np

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.manager import Manager
from autotuner.application.tuning_run import TuningRequest
from autotuner.configuration import parse_configuration
from autotuner.core.verdict import Outcome, Verdict
from autotuner.ports import OUTPUT
from autotuner_sim import LoadStep, Noise, SteppedPlant
from autotuner_sim.devices.loop_device import Gains, LoopDevice
from benchmarks.accuracy.cases._plants import AMPLITUDE, BATCH, OUTPUT0, PV0
from benchmarks.safety._device import BenchDevice, Line
from benchmarks.safety._fault_kinds import DEEDS, KILL, KINDS, LINES, LYING, SPREAD, UNREACHABLE

LOOP = "TIC-101"
RESTORE_LIMIT_S = 120.0
TIME_LIMIT = 3.0
"""Time limit of a run, in the length of an undisturbed one."""
TOLERANCE = 0.5


@dataclass(frozen=True)
class Undisturbed:
    """How a plant does without noise, load and fault: length of the tuning, reach of the PV up and down."""

    ends_s: float
    up: float
    down: float


@dataclass(frozen=True)
class Case:
    seed: int
    kind: str
    plant: int
    at_s: float
    lasts_s: float
    size: float
    noise: float
    load: tuple[float, float]
    auto: bool
    slew: float | None
    safe: float | None
    low: float
    high: float
    check: bool
    time_limit_s: float
    foreign_output: float

    @property
    def dt(self):
        return BATCH[self.plant].sample_s

    @property
    def pv_timeout_s(self):
        return max(10.0 * self.dt, 2.0)

    @property
    def table(self):
        limits = {"output": [0.0, 100.0], "pv": [self.low, self.high]}
        limits |= {"output_slew_per_s": self.slew} if self.slew else {}
        limits |= {"safe_output": self.safe} if self.safe is not None else {}
        return {
            "driver": "simulated",
            "sample_time_s": self.dt,
            "limits": limits,
            "relay": {"amplitude": AMPLITUDE, "check": self.check, "time_limit_s": self.time_limit_s},
            "restore_limit_s": RESTORE_LIMIT_S,
            "device": {"plant": {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5}},
        }


def calm_case(plant):
    """Return the case without noise, load, fault and limits."""
    return Case(
        seed=0,
        kind="no fault",
        plant=plant,
        at_s=0.0,
        lasts_s=0.0,
        size=0.0,
        noise=0.0,
        load=(0.0, 0.0),
        auto=False,
        slew=None,
        safe=None,
        low=-1e4,
        high=1e4,
        check=True,
        time_limit_s=1e6,
        foreign_output=0.0,
    )


def draw(kind, number, undisturbed):
    """Return the case of that number; the same for ever."""
    rng = np.random.default_rng([number, zlib.crc32(kind.encode())])
    plant = int(rng.integers(len(BATCH)))
    calm, dt = undisturbed[plant], BATCH[plant].sample_s
    reach = max(calm.up, calm.down)
    low, high = rng.uniform(0.5, 1.5, 2) if rng.random() < (0.9 if kind == "PV near its limit" else 0.1) else (6.0, 6.0)
    lasting = kind in LYING or kind in {"call never ends", "slow replies"}
    short_s, long_s = rng.uniform(0.0, 10.0) * dt, rng.uniform(1.0, 200.0)
    return Case(
        seed=number,
        kind=kind,
        plant=plant,
        at_s=float(rng.uniform(0.0, 0.9 * calm.ends_s)),
        lasts_s=float(short_s if rng.random() < 0.3 else (math.inf if lasting else long_s)),
        size=float(rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 8.0)) * (reach if kind == "PV jumps" else 1.0),
        noise=float(rng.choice([0.0, 0.005, 0.01, 0.03])) * reach,
        load=(float(rng.uniform(0.0, calm.ends_s)), float(rng.uniform(-4.0, 4.0)) if rng.random() < 0.4 else 0.0),
        auto=bool(rng.random() < 0.3),
        slew=float(2.0 * AMPLITUDE / (rng.uniform(2.0, 10.0) * dt)) if rng.random() < 0.2 else None,
        safe=20.0 if rng.random() < 0.3 else None,
        low=PV0 - low * calm.down,
        high=PV0 + high * calm.up,
        check=bool(rng.random() < 0.5),
        time_limit_s=TIME_LIMIT * calm.ends_s,
        foreign_output=float(rng.choice([5.0, 60.0])),
    )


def make_plant(case):
    sensors = [Noise(case.noise, case.seed)] if case.noise else []
    loads = [LoadStep(*case.load)] if case.load[1] else []
    return SteppedPlant(
        BATCH[case.plant].plant,
        output0=OUTPUT0,
        pv0=PV0,
        output_limits=(0.0, 100.0),
        sensors=sensors,
        loads=loads,
    )


def make_backend(case):
    plant = make_plant(case)
    device = LoopDevice(plant, scan_s=case.dt, gains=Gains(kp=0.1, ti=60.0), set_point=PV0, auto=case.auto)
    return BenchDevice(device, plant, make_line(case))


def make_line(case):
    return LINES[case.kind](case.at_s, case.lasts_s, case.dt, abs(case.size)) if case.kind in LINES else Line()


@dataclass(frozen=True)
class Answering(InPlace):
    """Identification that answers at once, or fails: it is not what this bench is about."""

    kind: str

    async def run(self, function, /, *_args, **_kwargs):
        if self.kind == "exception in identification":
            raise MemoryError("injected")
        if function.__name__ == "running_model":
            return None
        verdict = Verdict(Outcome.DONE, "done", "identified")
        none = SimpleNamespace(model=None)
        return SimpleNamespace(verdict=verdict, messages=(), identification=none, gains=None, to_dict=dict)


def make_manager(case, backend, folder):
    configuration = parse_configuration(
        {"service": {"data_directory": str(folder)}, "loops": {LOOP: case.table}}, "bench"
    )
    manager = Manager(configuration, Answering(case.kind), lambda: "T1")
    # in the place of the device that a driver would make
    manager._furnish(LOOP, configuration.loop(LOOP), backend)  # noqa: SLF001
    return manager


@dataclass
class Run:
    """What came of a case."""

    case: Case
    verdict: Verdict | None
    ended_s: float
    restored: bool
    unknown_meanwhile: bool
    hit: bool
    trace: list
    written: list
    touched: bool
    gap_s: float = 0.0


async def conduct(case, backend, folder):
    """Start a tuning, let the fault strike, and wait until the tuning is over."""
    manager = make_manager(case, backend, folder)
    tuning = manager.start(LOOP, TuningRequest(manager.configuration.loop(LOOP).experiment_settings()))
    run = SimpleNamespace(
        case=case,
        backend=backend,
        manager=manager,
        tuning=tuning,
        work=manager._tasks["T1"],  # noqa: SLF001 - to be cancelled, which nobody else does
        lasts_s=case.lasts_s,
        struck=False,
    )
    fault = asyncio.create_task(strike(run))
    await asyncio.wait([run.work])
    ended_s = backend.now_s()
    fault.cancel()
    await asyncio.gather(fault, return_exceptions=True)
    await manager.close()
    return tuning, ended_s, run.struck or getattr(backend.line, "hit", False)


async def strike(run):
    if run.case.kind in DEEDS:
        await asyncio.sleep(run.case.at_s)
        run.struck = True
        await DEEDS[run.case.kind](run)


async def whole_run(case, folder):
    """One case from start to settled plant."""
    backend = make_backend(case)
    observer = asyncio.create_task(backend.observe(case.dt))
    tuning, ended_s, hit = await conduct(case, backend, folder)
    unknown, restored = False, tuning.to_dict()["restored"]
    if restored is False:
        unknown = tuning.verdict.code == "output_unknown"
        restored = await made_good(case, backend, folder)
    touched = bool(backend.written)
    await settle(case, observer)
    run = Run(case, tuning.verdict, ended_s, bool(restored), unknown, hit, backend.trace, backend.written, touched)
    run.gap_s = case.lasts_s if case.kind == "clock gap" and hit else 0.0
    return run


async def made_good(case, backend, folder):
    """Start the program again once the line is back; return whether the loop was given back."""
    await asyncio.sleep(max(case.at_s + case.lasts_s - backend.now_s(), 0.0) + 1.0)
    manager = make_manager(case, backend, folder)
    manager.open()
    if "T1" not in manager.tunings:
        return False
    async for _ in manager.tuning("T1").follow():
        pass
    await manager.close()
    return manager.tuning("T1").restored


async def settle(case, observer):
    """Let the plant show what is still on its way."""
    plant = BATCH[case.plant].plant
    await asyncio.sleep(3.0 * plant.D + 20.0 + 10.0 * case.dt)
    observer.cancel()
    await asyncio.gather(observer, return_exceptions=True)


def in_virtual_time(work):
    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        return runner.run(work)


def killed_run(case, folder):
    """The same with a process that kills itself in the middle; its parent starts again."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            in_virtual_time(until_killed(case, folder, writer))
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        backend, backend.epoch_s, verdict, ended_s = pickle.load(pipe)  # noqa: S301 - our own child's
    os.waitpid(child, 0)
    return in_virtual_time(after_the_kill(case, folder, backend, verdict, ended_s))


async def until_killed(case, folder, writer):
    backend = make_backend(case)
    observer = asyncio.create_task(backend.observe(case.dt))

    def leave(verdict, ended_s):
        backend.present()
        backend.line = Line()
        with os.fdopen(writer, "wb") as pipe:
            pickle.dump((backend, backend.now_s(), verdict, ended_s), pipe)
        os.kill(os.getpid(), signal.SIGKILL)

    asyncio.get_running_loop().call_at(case.at_s, leave, None, case.at_s)
    tuning, ended_s, _ = await conduct(case, backend, folder)
    observer.cancel()
    leave(tuning.verdict, ended_s)


async def after_the_kill(case, folder, backend, verdict, ended_s):
    observer = asyncio.create_task(backend.observe(case.dt))
    restored = True
    if verdict is None:
        await asyncio.sleep(abs(case.size))
        manager = make_manager(case, backend, folder)
        manager.open()
        async for _ in manager.tuning("T1").follow():
            pass
        verdict, ended_s = manager.tuning("T1").verdict, backend.now_s()
        restored = verdict.code == "interrupted"
        await manager.close()
    await settle(case, observer)
    return Run(
        case=case,
        verdict=verdict,
        ended_s=ended_s,
        restored=restored,
        unknown_meanwhile=False,
        hit=True,
        trace=backend.trace,
        written=backend.written,
        touched=bool(backend.written),
    )


def perform(case):
    """Run a case in a data directory of its own."""
    shared = "/dev/shm"  # noqa: S108 - memory, so that the bench does not measure a disk
    logging.disable(logging.CRITICAL)
    try:
        with tempfile.TemporaryDirectory(dir=shared if Path(shared).is_dir() else None) as folder:
            if case.kind == KILL:
                return judge(killed_run(case, Path(folder)))
            return judge(in_virtual_time(whole_run(case, Path(folder))))
    finally:
        logging.disable(logging.NOTSET)


@dataclass(frozen=True)
class Judged:
    case: Case
    code: str
    hit: bool
    faults: tuple[str, ...]
    driven_s: float
    driven: float
    after: float
    until_safe_s: float
    unknown_meanwhile: bool


def judge(run):
    """Hold a run against what is required of it."""
    case = run.case
    t, pv, output, auto = (np.array(column, float) for column in zip(*run.trace, strict=True))
    safe = at_rest(run, output, auto)
    beyond = np.maximum(np.maximum(pv - case.high, case.low - pv), 0.0)
    unsafe = np.flatnonzero(~safe)
    safe_s = float(t[min(unsafe[-1] + 1, t.size - 1)]) if unsafe.size else 0.0
    driven_s = longest_s(t, (beyond > 3.0 * case.noise) & ~safe)
    failures = [
        *(["no verdict"] if run.verdict is None else []),
        *(["not restored"] if not run.restored or not safe[-1] else []),
        *(["over time"] if run.ended_s > case.time_limit_s + run.gap_s + RESTORE_LIMIT_S + 60.0 else []),
        *broken_writes(run),
        *(["driven beyond the limit"] if driven_s > allowed_s(run) else []),
    ]
    stopped = run.verdict is not None and run.verdict.outcome in {Outcome.ABORTED, Outcome.FAILED} and run.hit
    struck_s = run.ended_s if case.kind in SPREAD else case.at_s
    return Judged(
        case=case,
        code=run.verdict.code if run.verdict else "none",
        hit=run.hit,
        faults=tuple(failures),
        driven_s=driven_s,
        driven=float(beyond[~safe].max(initial=0.0)),
        after=float(beyond[safe].max(initial=0.0)),
        until_safe_s=max(safe_s - struck_s, 0.0) if stopped else math.nan,
        unknown_meanwhile=run.unknown_meanwhile,
    )


def longest_s(t, rows):
    """Return the length of the longest stretch of rows."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], rows, [False]))))
    return max((float(t[min(last, t.size - 1)] - t[first]) for first, last in edges.reshape(-1, 2)), default=0.0)


def at_rest(run, output, auto):
    """Return, for each row of the trace, whether the loop stands as it may stand at the end."""
    case = run.case
    targets = [OUTPUT0] + ([case.safe] if case.safe is not None else [])
    if case.kind == "operator moves the output" and not run.touched:
        targets.append(case.foreign_output)
    at_target = np.min([np.abs(output - target) for target in targets], axis=0) <= TOLERANCE
    taken_over = auto.astype(bool) & (case.auto or case.kind == "operator takes the mode")
    return taken_over | (at_target & ~auto.astype(bool) & (not case.auto or case.kind == "operator takes the mode"))


def broken_writes(run):
    """Return what was written against limits and slew."""
    case = run.case
    writes = [(t, value) for t, name, value in run.written if name == OUTPUT]
    faults = [] if all(0.0 <= value <= 100.0 for _, value in writes) else ["written beyond limits"]
    if case.slew and case.kind not in {"operator moves the output", "operator takes the mode"} and not case.auto:
        values = [OUTPUT0, *(value for _, value in writes)]
        steps = np.abs(np.diff(values))
        faults += ["written faster than the slew"] if steps.max(initial=0.0) > case.slew * case.dt + 1e-9 else []
    return faults


def allowed_s(run):
    """Return for how long an output may be driven while the true PV is beyond its limit."""
    case = run.case
    allowed = 4.0 * case.dt + (2.0 * AMPLITUDE / case.slew if case.slew else 0.0) + run.gap_s
    if not run.hit:
        return allowed
    if case.kind in LYING:
        return math.inf
    if case.kind in UNREACHABLE:
        return allowed + case.pv_timeout_s + 120.0 + min(case.lasts_s, 400.0)
    return allowed + {
        "slow replies": case.pv_timeout_s + 4.0 * abs(case.size) * case.dt,
        KILL: abs(case.size) + 1.0,
    }.get(case.kind, 0.0)


def undisturbed(index):
    """Measure a plant of the batch without noise, load and fault."""
    with tempfile.TemporaryDirectory() as folder:
        run = in_virtual_time(whole_run(calm_case(index), Path(folder)))
    pv = np.array([row[1] for row in run.trace])
    if run.verdict.code != "done":
        raise RuntimeError(f"{BATCH[index].name} cannot be tuned undisturbed: {run.verdict}")
    return Undisturbed(run.ended_s, float(pv.max()) - PV0, PV0 - float(pv.min()))


def cases(runs, calm, kinds=KINDS):
    """Return that many cases, spread evenly over the kinds of faults."""
    each = math.ceil(runs / len(kinds))
    return [draw(kind, number, calm) for kind in kinds for number in range(each)]


def report(judged, calm):
    """Return the table."""
    rows = [
        "fault                         runs struck  safe unknown   s until safe   driven on     after  ended as",
        "                                                meanwh. median/largest  s    in A       in A",
    ]
    for kind in dict.fromkeys(one.case.kind for one in judged):
        of_kind = [one for one in judged if one.case.kind == kind]
        until = np.array([one.until_safe_s for one in of_kind if math.isfinite(one.until_safe_s)])
        amplitude = [max(calm[one.case.plant].up, calm[one.case.plant].down) for one in of_kind]
        codes = collections.Counter(one.code for one in of_kind)
        spread = f"{np.median(until):.2f} / {until.max():.1f}" if until.size else "-"
        rows.append(
            f"{kind:28} {len(of_kind):5d} {sum(one.hit for one in of_kind):6d} "
            f"{sum('not restored' not in one.faults for one in of_kind):5d} "
            f"{sum(one.unknown_meanwhile for one in of_kind):7d} {spread:>14} "
            f"{max(one.driven_s for one in of_kind):6.1f} "
            f"{max(one.driven / a for one, a in zip(of_kind, amplitude, strict=True)):6.2f} "
            f"{max(one.after / a for one, a in zip(of_kind, amplitude, strict=True)):6.2f}  "
            + ", ".join(f"{code} {count}" for code, count in codes.most_common(5))
        )
    return "\n".join(rows)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=2200)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--kind", action="append", choices=KINDS)
    parser.add_argument("--seed", type=int, help="one run of one kind, by the number that a failure names")
    options = parser.parse_args(arguments)
    parallel = joblib.Parallel(options.jobs)
    calm = parallel(joblib.delayed(undisturbed)(index) for index in range(len(BATCH)))
    drawn = cases(options.runs, calm, tuple(options.kind or KINDS))
    if options.seed is not None:
        drawn = [draw(kind, options.seed, calm) for kind in options.kind]
    judged = parallel(joblib.delayed(perform)(case) for case in drawn)
    print(report(judged, calm))
    bad = [one for one in judged if one.faults]
    for one in bad:
        print(f"NOT MET  --kind {one.case.kind!r} --seed {one.case.seed}: {', '.join(one.faults)} ({one.code})")
    print(f"{len(judged)} runs, {len(judged) - len(bad)} as required, {len(bad)} not")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
