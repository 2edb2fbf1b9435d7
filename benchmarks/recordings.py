"""Real recordings: simulation error on the half that was not fitted, beside subspace and ARX fits of the same order.

    python benchmarks/recordings.py DATA

DATA is a folder with recordings of TCLab heaters, a hair dryer and a heated box. Where a second heater moves, the
record is taken twice: with the output alone, and with the second heater as a measured input, for all alike. Every
model is fitted to the first half and then simulated (not predicted: no measured PV goes in) over the whole record, its
initial state and offset fitted to the first half; the error is that of the second half. The others are fitted at every
order and delay up to ours (order) or the limit below (delay, one sample at least: with none, a record under a P
controller is explained by that controller's inverse), and the one that simulates the FIRST half best is taken, so that
nothing is chosen by the half it is judged on.

    n4sid   package nfoursid, no dependency of this program: left out where it is not installed
    ARX     equation error, by linear least squares, here
"""

import argparse
import contextlib
import importlib
import importlib.util
import itertools
import math
import warnings
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.signal import lfilter

from autotuner.core.identification import identify, simulate_fit, without_disturbances
from autotuner.core.recording import Recording

SHOW = Console(width=170)
LONGEST_DELAY = 20
BLOCK_ROWS = 15
MOST_SAMPLES = 1500
SECOND = "heater 2"


def recordings(data):
    """Yield a name and a recording of each."""
    tclab, box = data / "tclab_byu", data / "box_heater"

    def table(file, columns, **options):
        rows = np.genfromtxt(file, delimiter=",", **options)
        rows = rows[np.all(np.isfinite(rows[:, columns]), axis=1)]
        rows = rows[np.concatenate(([True], np.diff(rows[:, columns[0]]) > 0.0))]
        t, u, y, *more = (rows[:, column] for column in columns)
        return Recording(t, u, y, extra=dict(zip((SECOND,), more, strict=False)))

    yield "TCLab, step of the heater, K", table(tclab / "step_test_voltage_K.csv", [0, 1, 2])
    yield "TCLab, steps of the heater, F", table(tclab / "steps_voltage_F.csv", [0, 1, 2], skip_header=1)
    for columns, how in (([0, 1, 3], "not given"), ([0, 1, 3, 2], "given")):
        yield f"TCLab, heater 1; 2 {how}", table(tclab / "mimo_3s.csv", columns, skip_header=1)
        yield f"TCLab, random heaters; 2 {how}", table(tclab / "mimo_prbs_3s.csv", columns, skip_header=1)
        yield f"TCLab, moving horizon, 3 s; 2 {how}", table(tclab / "mhe_3s.csv", columns)
        yield f"TCLab, steps of both, 1 s; 2 {how}", table(tclab / "mimo_steps_1s.csv", columns, skip_header=1)
    yield "TCLab, moving horizon, 2 s", table(tclab / "mhe_2s.csv", [0, 1, 3])
    rows = np.loadtxt(data / "dryer" / "dryer.dat")
    yield "hair dryer", Recording(0.08 * np.arange(len(rows)), rows[:, 0], rows[:, 1])
    for name in ("log-1-kp1", "log-2-kp2", "log-4-pid-kp8", "log-5-pid-kp4-ki0_1", "log-7-pid-kp1_6-ki0_019_kd80"):
        yield f"heated box, {name}", table(box / f"{name}.csv", [0, 7, 1], skip_header=1)


def evenly(recording):
    """Return a recording at even times, as the others need it, and how many samples are its first half."""
    dt = max(recording.sample_interval_s, recording.duration_s / MOST_SAMPLES)
    t = np.arange(recording.t[0], recording.t[-1], dt)
    rows = np.searchsorted(recording.t, t, side="right") - 1
    inputs = [held[rows] for held in (recording.output, *recording.extra.values())]
    return t, inputs, np.interp(t, recording.t, recording.pv)


def later(inputs, delays):
    """Return the inputs, each so many samples later."""
    return np.array([np.concatenate((np.full(d, u[0]), u))[: u.size] for u, d in zip(inputs, delays, strict=True)])


def about_mean(inputs, half):
    """Return the inputs about their means over the first half."""
    return inputs - inputs[:, :half].mean(axis=1, keepdims=True)


def delays_of(inputs, least):
    """Yield the delays that are tried, every input with its own."""
    yield from itertools.product(range(least, least + LONGEST_DELAY + 1), repeat=len(inputs))


def completed(simulate, u, y, half, states):
    """Return a simulated PV, initial state and offset fitted to the first half; `simulate(u, x0)` is linear in both."""
    driven = simulate(u, np.zeros(states))
    free = [simulate(np.zeros_like(u), column) for column in np.eye(states)]
    phi = np.column_stack([*free, np.ones(y.size)])
    found, *_ = np.linalg.lstsq(phi[:half], (y - driven)[:half], rcond=None)
    return driven + phi @ found


def by_n4sid(inputs, y, half, order):
    """Yield the simulations of subspace models of every delay."""
    if importlib.util.find_spec("nfoursid") is None:
        return
    nfoursid = importlib.import_module("nfoursid.nfoursid")
    pandas = importlib.import_module("pandas")
    names = [f"u{k}" for k in range(len(inputs))]
    for delays in delays_of(inputs, 1):
        u = about_mean(later(inputs, delays), half)
        frame = pandas.DataFrame({**dict(zip(names, u[:, :half], strict=True)), "y": (y - y[:half].mean())[:half]})
        with contextlib.suppress(Exception), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fit = nfoursid.NFourSID(frame, output_columns=["y"], input_columns=names, num_block_rows=BLOCK_ROWS)
            fit.subspace_identification()
            model, _ = fit.system_identification(rank=order)

            def simulate(u, x, model=model):
                out, driven, fed = np.empty(u.shape[1]), model.b @ u, model.d @ u
                for k in range(out.size):
                    out[k] = (model.c @ x).item() + fed[0, k]
                    x = model.a @ x + driven[:, k]
                return out

            yield f"n4sid({order}), delay {named(delays)}", completed(simulate, u, y, half, order)


def by_arx(inputs, y, half, order):
    """Yield the simulations of ARX models of every delay."""
    for delays in delays_of(inputs, 0):
        with contextlib.suppress(Exception):
            centred = about_mean(np.array(inputs), half)
            a, b = arx(centred[:, :half], y[:half] - y[:half].mean(), order, delays)
            u = later(centred, [delay + 1 for delay in delays])

            def simulate(u, x, a=a, b=b):
                first = lfilter(b[0], a, u[0], zi=x)[0]
                return first + sum(lfilter(part, a, one) for part, one in zip(b[1:], u[1:], strict=True))

            yield f"ARX({order},{order},{named(delays)})", completed(simulate, u, y, half, order)


def named(delays):
    return "+".join(str(delay) for delay in delays)


def arx(inputs, y, order, delays):
    """Return denominator and numerators, these from one sample beyond the delays on, by linear least squares."""
    rows = np.arange(order + max(delays) + 1, y.size)
    late = list(zip(inputs, delays, strict=True))
    past = [-y[rows - i] for i in range(1, order + 1)] + [u[rows - d - i] for u, d in late for i in range(1, order + 1)]
    found = np.linalg.lstsq(np.column_stack(past), y[rows], rcond=None)[0].reshape(-1, order)
    return np.append(1.0, found[0]), [np.append(part, 0.0) for part in found[1:]]


def best(simulations, y, half):
    """Return the name and the simulation with the smallest error on the first half."""
    finite = [(name, sim) for name, sim in simulations if np.all(np.isfinite(sim)) and np.abs(sim).max() < 1e9]
    return min(finite, key=lambda pair: rms((pair[1] - y)[:half]), default=(None, None))


def rms(left):
    return math.sqrt(float(np.mean(left**2)))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    args = parser.parse_args()
    table = Table(title="root mean square error of the simulation on the half not fitted", title_justify="left")
    for title in ("recording", "ours", "error", "n4sid", "error", "ARX", "error", "ours over best"):
        table.add_column(title)
    for name, recording in recordings(args.data):
        middle = float(recording.t[0] + recording.duration_s / 2.0)
        found = identify(recording.window(float(recording.t[0]), middle), disturbances=list(recording.extra))
        model = found.model or found.estimates["least_squares"].model
        if model is None:
            table.add_row(name, found.verdict.message[:40])
            continue
        answer = without_disturbances(recording, model, found.disturbances)
        ours = rms((answer.pv - simulate_fit(model, answer, middle))[recording.t > middle])
        order = 2 if model.structure not in {"fopdt", "unstable_fopdt"} else 1
        t, inputs, y = evenly(recording)
        half = int(np.searchsorted(t, middle))
        cells, errors = [], []
        for family in (by_n4sid, by_arx):
            which, simulation = best(
                [pair for n in range(1, order + 1) for pair in family(inputs, y, half, n)], y, half
            )
            error = math.inf if which is None else rms((simulation - y)[half:])
            cells += [which or "no model", f"{error:.4g}"]
            errors.append(error)
        table.add_row(name, str(model.structure), f"{ours:.4g}", *cells, f"{ours / min(errors):.2f}")
    SHOW.print(table)


if __name__ == "__main__":
    main()
