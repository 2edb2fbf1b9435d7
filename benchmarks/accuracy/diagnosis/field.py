"""Recordings of real processes: the error before and after the effect that the diagnosis names.

    autotuner bench field --data DIR [DIR ...] [--only tanks] [--jobs 2] [--json]

Each `DIR` holds recordings, or one folder a process, with a SOURCE.md; what is absent is skipped and said. For every
recording the table gives the verdict, the effects, the error on the part that was not fitted before and after, and what
is expected:

    tanks        pump voltage to the lower level; the estimation set is fitted, the test set held out and joined to it
                 after a pause under the first voltage, because both sets begin from the same unknown levels. Expected:
                 at most 0.40 V on the test set (linear models reach about 0.59 V)
    tclab        heater 1 to temperature 1, without and with the second heater, and with the second temperature, as
                 measured columns. Expected: a lower held-out error with them
    box          heater current to the inside temperature, without and with the measured ambient. Expected: the same
    oven         Peltier element to temperature, without and with the measured ambient. Expected: the same
    chamber      heater to temperature, without and with the measured ambient. Expected: the same
    servo        motor force to position, and to velocity, of a robot axis with Coulomb friction. Expected: friction of
                 the process
    oscillator   voltage in and out of an electronic oscillator with a hardening spring. Expected: a stiffness that
                 depends on the PV, and at most a tenth of the linear error (published: a thirtieth)
    hoop         motor to the angle of a ball in a hoop. Expected: dead zone, friction or the pendulum's stiffness
    sticking     closed loops whose valve sticks. Expected: stiction or backlash among the effects
    not sticking loops and a process without. Expected: neither
"""

import argparse
import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import joblib
import numpy as np

import autotuner
from autotuner.errors import AutotunerError

FRICTION = {"stiction", "backlash"}
COLUMNS = {"measured_disturbance", "ambient"}
PAUSE_S = 4000.0
TANKS_V = 0.40
OSCILLATOR_SHARE = 0.1
"""Largest error of the oscillator on the part not fitted, over that of the linear model."""
MET = {None: "-", True: "met", False: "NOT MET"}
HOOP = {*FRICTION, "static_nonlinearity", "process_friction", "nonlinear_stiffness"}
"""What is in the motor and in the pendulum of the hoop."""


@dataclass(frozen=True)
class Item:
    """One recording: how it is read, and what of it is expected."""

    group: str
    name: str
    file: str
    read: Any
    met: Any = None
    """Whether a row is what is expected; None for a row that others are compared with."""
    beside: str | None = None
    """Name of the item whose held-out error this one is to undercut."""


def rows_of(path):
    """Return the numbers of a file with or without a line of titles, commas or blanks between."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    cells = [[cell.strip() for cell in re.split(r"[,\s]+", line.strip().rstrip(","))] for line in lines if line.strip()]
    numbers = [row for row in cells if all(re.fullmatch(r"[-+.\deE]+", cell) for cell in row)]
    width = max(map(len, numbers))
    return np.array([row for row in numbers if len(row) == width], dtype=float)


def titled(path):
    """Return the columns of a file by title."""
    head, *lines = path.read_text(encoding="utf-8-sig").splitlines()
    titles = [title.strip().strip('"') for title in head.split(",")]
    rows = [line.split(",") for line in lines if line.strip()]
    return {
        title: np.array([float(row[k]) if k < len(row) and row[k].strip() else np.nan for row in rows])
        for k, title in enumerate(titles)
        if title
    }


def recording(t, output, pv, extra=None, settings=None):
    """Return a recording of columns, rows with a gap left out."""
    good = np.isfinite(t) & np.isfinite(output) & np.isfinite(pv)
    good[1:] &= np.diff(t) > 0.0
    columns = {name: column[good] for name, column in (extra or {}).items()}
    return autotuner.Recording(t[good], output[good], pv[good], extra=columns, settings=settings or {})


def tanks(path):
    c = titled(path)
    step_s = float(c["Ts"][0])
    first = np.arange(c["uEst"].size) * step_s
    later = first + first[-1] + step_s + PAUSE_S
    output = np.concatenate((c["uEst"], c["uVal"]))
    output[first.size - 1] = c["uEst"][0]
    settings = {"segments": {"tail": float(later[0])}, "restarts_s": [float(later[0])]}
    return recording(np.concatenate((first, later)), output, np.concatenate((c["yEst"], c["yVal"])), settings=settings)


def tclab(*extra):
    """Return a reader of time, heaters 1 and 2, temperatures 1 and 2."""

    def read(path):
        t, q1, q2, t1, t2 = rows_of(path)[:, :5].T
        columns = {"heater_2": q2, "temperature_2": t2}
        return recording(t, q1, t1, {name: columns[name] for name in extra})

    return read


def box(*extra):
    def read(path):
        c = titled(path)
        columns = {"ambient": c["ext_temp_c"]}
        return recording(c["time_s"], c["amps"], c["int_temp_c"], {name: columns[name] for name in extra})

    return read


def loop(path):
    """A closed loop: time, controller output, PV."""
    c = titled(path)
    return recording(c["t_s"], c["op_pct"] if "op_pct" in c else c["op"], c["pv"])


def logged(*extra):
    """Return a reader of time, output, PV and further columns by title."""

    def read(path):
        c = titled(path)
        return recording(c["t"], c["u"], c["y"], {name: c[name] for name in extra})

    return read


def dryer(path):
    u, y = rows_of(path)[:, :2].T
    return recording(0.08 * np.arange(u.size), u, y)


def tanks_met(row, _rows):
    return row["held_after"] <= TANKS_V


def sticks(row, _rows):
    return bool(FRICTION & set(row["effects"]))


def does_not_stick(row, _rows):
    return not FRICTION & set(row["effects"])


def drags(row, _rows):
    return "process_friction" in row["effects"]


def hardens(row, _rows):
    return "nonlinear_stiffness" in row["effects"] and row["held_after"] <= OSCILLATOR_SHARE * row["held_before"]


def like_the_hoop(row, _rows):
    return bool(HOOP & set(row["effects"]))


def better(row, rows):
    """Return whether the column is taken in, and the error is lower with it; one that is refused without has none."""
    other = rows.get(row["beside"], {"held_after": math.nan})
    return bool(COLUMNS & set(row["effects"])) and not row["held_after"] >= other["held_after"]


COLUMNS_OF_TCLAB = {
    "heater 2": ("heater_2",),
    "temperature 2": ("temperature_2",),
    "both": ("heater_2", "temperature_2"),
}
V, T, B = "valve_stiction/", "tclab_byu/", "box_heater/"
ITEMS = (
    Item("tanks", "cascaded tanks", "cascaded_tanks/dataBenchmark.csv", tanks, tanks_met),
    *(
        item
        for name in ("mimo_3s", "mimo_prbs_3s", "mimo_steps_1s", "mhe_3s")
        for item in (
            Item("tclab", f"{name}: alone", f"{T}{name}.csv", tclab()),
            *(
                Item("tclab", f"{name}: {column}", f"{T}{name}.csv", tclab(*titles), better, f"{name}: alone")
                for column, titles in COLUMNS_OF_TCLAB.items()
            ),
        )
    ),
    Item("box", "log-5: alone", f"{B}log-5-pid-kp4-ki0_1.csv", box()),
    Item("box", "log-5: ambient", f"{B}log-5-pid-kp4-ki0_1.csv", box("ambient"), better, "log-5: alone"),
    *(
        item
        for name, file in (("oven", "peltier_oven_run1.csv"), ("chamber", "chamber_run11.csv"))
        for item in (
            Item(name, f"{name}: alone", file, logged()),
            Item(name, f"{name}: ambient", file, logged("ambient"), better, f"{name}: alone"),
        )
    ),
    Item("servo", "servo position", "servo_position.csv", logged(), drags),
    Item("servo", "servo velocity", "servo_velocity.csv", logged(), drags),
    Item("oscillator", "oscillator", "oscillator_multisine.csv", logged(), hardens),
    Item("hoop", "ball and hoop", "ball_and_hoop_steps.csv", logged(), like_the_hoop),
    Item("sticking", "FIC46005", f"{V}stiction_2111FIC46005_0614_0003.csv", loop, sticks),
    Item("sticking", "FIC20102", f"{V}stiction_2411FIC20102_0825_0004.csv", loop, sticks),
    Item("sticking", "CHEM1", f"{V}isdb_CHEM1.csv", loop, sticks),
    Item("sticking", "CHEM10", f"{V}isdb_CHEM10.csv", loop, sticks),
    Item("sticking", "AIC90201", "valve_stic_2411AIC90201_1002_0004.csv", logged(), sticks),
    Item("sticking", "LIC30501", "valve_stic_2411LIC30501_1107_0013.csv", logged(), sticks),
    Item("sticking", "FIC31102", "valve_stic_2CDU_FIC31102_0628_0002.csv", logged(), sticks),
    Item("not sticking", "FIC10201", f"{V}nostiction_2111FIC10201_1018_0002.csv", loop, does_not_stick),
    Item("not sticking", "LIC31102B", f"{V}nostiction_2111LIC31102B_0824_0008.csv", loop, does_not_stick),
    Item("not sticking", "PAP9", f"{V}isdb_PAP9.csv", loop, does_not_stick),
    Item("not sticking", "CHEM13", f"{V}isdb_CHEM13.csv", loop, does_not_stick),
    Item("not sticking", "FIC41004", "valve_nostic_2111FIC41004_1108_0013.csv", logged(), does_not_stick),
    Item("not sticking", "FIC20502", "valve_nostic_2411FIC20502_0904_0005.csv", logged(), does_not_stick),
    Item("not sticking", "PDIC10321", "valve_nostic_2411PDIC10321_1016_0008.csv", logged(), does_not_stick),
    Item("not sticking", "dryer", "dryer/dryer.dat", dryer, does_not_stick),
)


def perform(number, folders):
    """Return one row of the table; None when the file is in none of the folders."""
    item = ITEMS[number]
    path = next((file for folder in folders if (file := folder / item.file).is_file()), None)
    if path is None:
        return None
    row = {"group": item.group, "name": item.name, "beside": item.beside}
    try:
        answer = autotuner.diagnose(item.read(path)).to_dict()
    except AutotunerError as error:
        return row | {"verdict": f"refused: {error}", "effects": [], "held_before": np.nan, "held_after": np.nan}
    misfit = answer["error"]
    return row | {
        "verdict": answer["verdict"],
        "effects": [effect["name"] for effect in answer["effects"]],
        "confidence": [effect["confidence"] for effect in answer["effects"]],
        "alike": [effect["indistinguishable"] for effect in answer["effects"]],
        "sizes": [effect["parameters"] for effect in answer["effects"]],
        "fitted_before": misfit["fitted"]["before"],
        "fitted_after": misfit["fitted"]["after"],
        "held_before": misfit["held_out"]["before"],
        "held_after": misfit["held_out"]["after"],
        "noise": misfit["held_out"]["noise"],
        "notes": answer["notes"],
    }


def show(rows):
    print(f"{'':26} {'fitted before':>13} {'after':>8} {'held before':>11} {'after':>8}  expected  verdict")
    for row in rows.values():
        figures = [row.get(key, np.nan) for key in ("fitted_before", "fitted_after", "held_before", "held_after")]
        told = " ".join(f"{value:{width}.4g}" for value, width in zip(figures, (13, 8, 11, 8), strict=True))
        print(f"{row['name']:26} {told}  {MET[row['met']]:8}  {row['verdict']}"
              f" {', '.join(row['effects'])}")  # fmt: skip


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="folders of the recordings")
    parser.add_argument("--only", help="a group, or a part of a name")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="print one JSON object a line")
    options = parser.parse_args(arguments)
    wanted = [k for k, item in enumerate(ITEMS) if options.only in (None, item.group) or options.only in item.name]
    results = joblib.Parallel(options.jobs)(joblib.delayed(perform)(k, options.data) for k in wanted)
    for k, row in zip(wanted, results, strict=True):
        if row is None:
            print(f"skipped  {ITEMS[k].name}: {ITEMS[k].file} is absent")
    rows = {row["name"]: row for row in results if row is not None}
    for k in wanted:
        if ITEMS[k].name in rows:
            row = rows[ITEMS[k].name]
            row["met"] = None if ITEMS[k].met is None else bool(ITEMS[k].met(row, rows))
    if options.json:
        print("\n".join(json.dumps(row, default=float) for row in rows.values()))
    elif rows:
        show(rows)
        expected = {name: row["met"] for name, row in rows.items() if row["met"] is not None}
        missed = [name for name, met in expected.items() if not met]
        print(f"{len(rows)} rows, {len(expected)} with an expectation; {len(missed)} not met: {', '.join(missed)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
