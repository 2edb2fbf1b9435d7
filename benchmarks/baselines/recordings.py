"""Real recordings: simulation error on the half that was not fitted, beside subspace and ARX fits of packages.

    python benchmarks/baselines/recordings.py DATA

DATA is a folder with recordings of TCLab heaters, a hair dryer and a heated box. Where a second heater moves, the
record is taken twice: with the output alone, and with the second heater as a measured input, for all alike. Every
model is fitted to the first half and then simulated (not predicted: no measured PV goes in) over the whole record, its
initial state and offset fitted to the first half; the error is that of the second half. The others are those of
`_linear_models.py`, none a dependency of this program. What "of the same order" means, and who chooses the dead time
that they lack, can be read in several ways, and the losses are counted under each:

    any order      every order up to ours and every delay; taken is what simulates the FIRST half best, so that nothing
                   is chosen by the half it is judged on
    same order     our order; the delay chosen likewise
    left alone     our order; the delay by what the package goes by: N4SID none, ARX the one-step prediction
    heating        as any order, of those fits that settle and whose PV rises with every input: these are all heaters,
                   and the first box was moved by a P controller alone, whose inverse `y = r - u/kp` fits best of all

Last, what our model misses of the second half when it is fitted to both: what is more than that is not for want of a
structure, but because the first half does not tell.
"""

import argparse
import math
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from autotuner.core.identification import identify, simulate_fit, without_disturbances
from autotuner.core.recording import Recording
from benchmarks.baselines._linear_models import FAMILIES, tried

SHOW = Console(width=190)
MOST_SAMPLES = 1500
LEVEL = 1.01
"""Ratio of two errors up to which they count as level."""
AGAIN = "not given"
"""What the name of a recording says that is one of the others with less given."""
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


def rms(left):
    return math.sqrt(float(np.mean(left**2)))


def ours(recording, middle, until):
    """Return our model of the record up to a time, or the refusal's words, and its error on the second half."""
    found = identify(recording.window(float(recording.t[0]), until), disturbances=list(recording.extra))
    model = found.model or found.estimates["least_squares"].model
    if model is None:
        return None, found.verdict.message, math.inf
    answer = without_disturbances(recording, model, found.disturbances)
    left = (answer.pv - simulate_fit(model, answer, middle))[recording.t > middle]
    return model, str(model.structure), rms(left)


def readings(fits, order, y, half):
    """Return what each reading takes of the fits of one family."""

    def on_first(fit):
        return rms((fit.simulation - y)[:half])

    same = [fit for fit in fits if fit.order == order]
    return {
        "any order": min(fits, key=on_first, default=None),
        "same order": min(same, key=on_first, default=None),
        "left alone": min(same, key=lambda fit: fit.loss, default=None),
        "heating": min((fit for fit in fits if fit.heats), key=on_first, default=None),
    }


def compared(recording, middle, order):
    """Return, by reading and family, what is taken and its error on the second half."""
    t, inputs, y = evenly(recording)
    half = int(np.searchsorted(t, middle))
    result = {}
    for family in FAMILIES:
        fits = [fit for n in range(1, order + 1) for fit in tried(family, inputs, y, half, n)]
        for reading, fit in readings(fits, order, y, half).items():
            taken = ("none", math.inf) if fit is None else (fit.name, rms((fit.simulation - y)[half:]))
            result.setdefault(reading, {})[family.title] = taken
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    args = parser.parse_args()
    rows, both = [], []
    for name, recording in recordings(args.data):
        middle = float(recording.t[0] + recording.duration_s / 2.0)
        model, told, error = ours(recording, middle, middle)
        _, end_published, error_all = ours(recording, middle, float(recording.t[-1]))
        both.append((name, f"{error:.4g}", f"{error_all:.4g}", end_published))
        order = 1 if model is not None and model.structure in {"fopdt", "unstable_fopdt"} else 2
        rows.append((name, told, error, compared(recording, middle, order)))
    for reading in rows[0][3]:
        show(reading, rows)
    table = Table("recording", "fitted to the first half", "to both", "model", title="ours on the second half")
    for row in both:
        table.add_row(*row)
    SHOW.print(table)
    SHOW.print("Of the recordings, those given with less counted once:")
    for reading in rows[0][3]:
        count(reading, rows)


def show(reading, rows):
    """Print all errors under one reading."""
    table = Table(title=f"root mean square error on the half not fitted: {reading}", title_justify="left")
    for title in ("recording", "ours", "error", *(family.title for family in FAMILIES), "ours over best"):
        table.add_column(title)
    for name, told, error, result in rows:
        taken = result[reading].values()
        cells = [f"{best:.4g}  {which}" for which, best in taken]
        table.add_row(name, told[:40], f"{error:.4g}", *cells, f"{error / min(best for _, best in taken):.2f}")
    SHOW.print(table)


def count(reading, rows):
    """Print in how many recordings ours is better, level and worse, against all and against each that has a fit."""
    once = [(error, result[reading]) for name, _, error, result in rows if AGAIN not in name]
    titles = [family.title for family in FAMILIES]
    packages = {title.split(", ")[1]: [t for t in titles if t.endswith(title.split(", ")[1])] for title in titles}
    opponents = {"the best of all": titles, **packages, **{title: [title] for title in titles}}
    against = {
        whom: [error / best for error, result in once if (best := min(result[t][1] for t in members)) < math.inf]
        for whom, members in opponents.items()
    }
    for whom, ratios in against.items():
        worse, better = sum(r > LEVEL for r in ratios), sum(r < 1.0 / LEVEL for r in ratios)
        middle = math.exp(float(np.mean(np.log(np.maximum(ratios, 1e-9)))))
        level = len(ratios) - better - worse
        told = f"{better} better, {level} level, {worse} worse; geometric mean of the ratios {middle:.2f}"
        told += f"; {len(once) - len(ratios)} without a fit" if len(ratios) < len(once) else ""
        SHOW.print(f"  {reading}, against {whom}: {told}")


if __name__ == "__main__":
    main()
