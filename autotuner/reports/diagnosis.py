"""The diagnosis as sections of a report, and as its own report: verdict, effects, errors, pictures."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.design.gains import gains_from_dict
from autotuner.core.design.simulation.closed_loop_setup import Installed, responses
from autotuner.core.diagnosis.findings.gain_comparison import lasts_s
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.reports.curves import kept
from autotuner.reports.document import Grid, Picture, Section, Words, document
from autotuner.reports.numbers import Units, named, parameter_unit, with_unit
from autotuner.reports.pictures.chart import Chart, Curve, Panel, Span, output_panel

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.diagnosis import Diagnosis
    from autotuner.core.diagnosis.findings.result import FoundEffect, Traces
    from autotuner.core.model.arrays import FloatArray

BINS = 60
"""Bins of the output over which the mean residual is drawn."""
NAMES = {
    "phase_margin_deg": "phase margin, degrees",
    "delay_margin_s": "delay margin",
    "settling_time_s": "settling time",
    "set_point_iae": "integral of the error after a set-point step",
    "load_iae": "integral of the error after a load",
    "fitted": "part that was fitted",
    "selection": "part that chose the explanation",
    "held_out": "part kept for the test",
}
"""Names of quantities, and of the parts of a record, that are not words joined by underscores."""
UNITS = {
    "Kp": "output/PV",
    **dict.fromkeys(("Ti", "Td", "Tf", "delay_margin_s", "settling_time_s"), "s"),
    **dict.fromkeys(("set_point_iae", "load_iae"), "PV s"),
    **dict.fromkeys(("set_point_step",), "PV"),
    **dict.fromkeys(("load_step",), "output"),
}
"""Units of the numbers of gains; the others are ratios."""
AXES = {"output": "output", "last move of the output": "output", "PV": "PV", "slope of the PV": "PV/s", "time": "s"}
"""Units of the variables on the horizontal axis of the residual."""
UNKNOWN = Units()
LOOKS = {"adequate": "done", "explained": "refused", "partly_explained": "failed", "unexplained": "failed"}


def diagnosis_report(diagnosis: Diagnosis, name: str) -> str:
    """Return a diagnosis as one HTML file that loads nothing.

    Parameters
    ----------
    diagnosis : Diagnosis
        What was found.
    name : str
        Of the recording.
    """
    return document(f"Diagnosis of {name}", _worded(diagnosis.verdict), diagnosis_sections(diagnosis))


def diagnosis_sections(diagnosis: Diagnosis, units: Units = UNKNOWN, *, of_a_tuning: bool = False) -> list[Section]:
    """Return the sections: they may be part of a tuning's report, too.

    There process and gains are reported already; they are repeated only where the effects change them.
    """
    look = LOOKS[diagnosis.verdict]
    summary = [Words(_sentence(f"{_worded(diagnosis.verdict)}: {diagnosis.summary}"), look)]  # type: ignore[arg-type]
    notes = [Words(_sentence(note)) for note in diagnosis.notes]
    effects = [Section("Effects", _effects(diagnosis, units))] if diagnosis.effects else []
    drawn = [] if diagnosis.traces is None else [_pictures(diagnosis.traces, units)]
    drawn += _loop(diagnosis, units)
    changed = diagnosis.gains.get("before") != diagnosis.gains.get("after")
    models = [_models(diagnosis, units), *_gains(diagnosis, units)] if changed or not of_a_tuning else []
    return [
        Section("Effects missing in the model", [*summary, *notes]),
        *effects,
        *_missing(diagnosis),
        Section("Before and after", [_errors(diagnosis, units), *models]),
        *drawn,
    ]


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def _missing(diagnosis: Diagnosis) -> list[Section]:
    """Return the dependence of the residual on single variables where no effect explains it."""
    if not diagnosis.missing:
        return []
    rows = [[one.variable, f"{one.share:.0%}", one.shape] for one in diagnosis.missing]
    title = "Share of the residual that depends on one variable alone, on held-out samples"
    return [Section("Unexplained residual", [Grid(title, ("variable", "share", "grows"), rows)])]


def _effects(diagnosis: Diagnosis, units: Units) -> list[Grid | Words]:
    rows = [row for effect in diagnosis.effects for row in _effect(effect, units)]
    grid = Grid("Sizes with 95 % intervals", ("effect", "place", "size", "value", "95 % interval", "confidence"), rows)
    return [grid, *(Words(f"{effect.name}: {effect.advice}.") for effect in diagnosis.effects if effect.advice)]


def _effect(effect: FoundEffect, units: Units) -> list[list[str]]:
    rows = []
    for name, value in effect.parameters.items():
        low, high = effect.interval95.get(name, (math.nan, math.nan))
        unit = units.named(effect.units[name])
        interval = with_unit(f"{low:.4g} to {high:.4g}", unit) if math.isfinite(low + high) else ""
        size = with_unit(f"{value:.4g}", unit)
        rows.append([effect.title, effect.place, _worded(name), size, interval, f"{effect.confidence:.0%}"])
    return rows


def _errors(diagnosis: Diagnosis, units: Units) -> Grid:
    spread = {} if diagnosis.traces is None else _spreads(diagnosis.traces)
    rows = [
        [
            _worded(part),
            f"{misfit.before:.4g}",
            f"{misfit.after:.4g}",
            f"{misfit.noise:.4g}",
            f"{misfit.before / misfit.noise:.2f} to {misfit.after / misfit.noise:.2f}" if misfit.noise > 0.0 else "",
            " to ".join(_fit(error, spread[part]) for error in (misfit.before, misfit.after)) if part in spread else "",
        ]
        for part, misfit in diagnosis.error.items()
    ]
    titles = ("part", "before", "after", "noise", "in noise sigmas", "fit")
    title = f"Root mean square error, {units.pv}; fit: 1 - error/standard deviation of the PV"
    return Grid(title, titles, rows)


def _spreads(traces: Traces) -> dict[str, float]:
    early = traces.t <= traces.held_out_from_s
    parts = {"fitted": traces.pv[early], "held_out": traces.pv[~early]}
    return {part: float(np.std(pv)) for part, pv in parts.items() if pv.size}


def _fit(error: float, spread: float) -> str:
    return f"{1.0 - error / spread:.1%}" if spread > 0.0 and math.isfinite(error) else "-"


def _models(diagnosis: Diagnosis, units: Units) -> Grid:
    before, after = diagnosis.model.get("before"), diagnosis.model.get("after")
    names = [n for n in {**_plain(before), **_plain(after)} if n != "interval95"]
    structure = str(_plain(after).get("structure", ""))
    rows = [
        [_parameter(name, structure, units), _shown(_plain(before).get(name)), _shown(_plain(after).get(name))]
        for name in names
    ]
    return Grid("Process", ("", "before", "after"), rows)


def _parameter(name: str, structure: str, units: Units) -> str:
    return name if name == "structure" else named(name, parameter_unit(name, structure, units.pv, units.output))


def _gains(diagnosis: Diagnosis, units: Units) -> list[Grid]:
    """Return the gains of the requested design, with calmer ones where they are useful; nothing without any."""
    columns = {when: _flat(values) for when, values in diagnosis.gains.items()}
    goal_name = str(next((entry["goal"] for entry in columns.values() if "goal" in entry), ""))
    known = {name: None for entry in columns.values() for name, value in entry.items() if value is not None}
    names = [name for name in known if name != "goal"]
    rows = [[_quantity(name, units), *(_shown(entry.get(name)) for entry in columns.values())] for name in names]
    heads = [f"after, {entry['goal']}" if when == "calmer" else when for when, entry in columns.items()]
    return [Grid(f"Requested gains ({goal_name}) and margins", ("", *heads), rows)] if rows else []


def _loop(diagnosis: Diagnosis, units: Units) -> list[Section]:
    """Return the responses of the closed loop with the effects in it, to the gains before and after."""
    entry = {when: _plain(diagnosis.gains.get(when)) for when in ("before", "after")}
    gains = {when: gains_from_dict(_plain(values.get("gains"))) for when, values in entry.items() if values}
    sizes = _plain(entry["after"].get("with_effects"))
    traces, process = diagnosis.traces, diagnosis.process
    if not sizes or traces is None or process is None or set(gains) != {"before", "after"}:
        return []
    installed = Installed(
        float(np.median(np.diff(traces.t))),
        rest_output=float(traces.output[0]),
        effects=diagnosis.effects,
        set_point_step=float(sizes["set_point_step"]),  # type: ignore[arg-type]
        load_step=float(sizes["load_step"]),  # type: ignore[arg-type]
    )
    made = {when: responses(process, pid, installed, lasts_s(process)) for when, pid in gains.items()}
    first, second = made["before"], made["after"]
    panels = [
        Panel(
            named("PV after a step of the set point", units.pv),
            [Curve("before", first[0].pv, 1), Curve("after", second[0].pv, 5)],
        ),
        Panel(
            named("output", units.output),
            [Curve("before", first[0].output, 1), Curve("after", second[0].output, 5)],
            110.0,
        ),
        Panel(
            named("PV after a load", units.pv),
            [Curve("before", first[1].pv, 1), Curve("after", second[1].pv, 5)],
            130.0,
        ),
    ]
    title = f"The closed loop with {', '.join(installed.foreseen)} in it, gains before and after"
    words = "Predicted on the process without the effects, as deviation from rest."
    return [Section("The loop with the effects", [Picture(Chart(first[0].t, panels, title), words)])]


def _both(before: FloatArray, after: FloatArray) -> list[Curve]:
    return [Curve("before", before, 1), Curve("after", after, 5)]


def _plain(values: object) -> Mapping[str, object]:
    return values if isinstance(values, dict) else {}


def _flat(values: object) -> dict[str, object]:
    entry = _plain(values)
    beside = {name: v for name, v in _plain(entry.get("with_effects")).items() if name != "effects"}
    foreseen = {f"{name}, with the effects": v for name, v in beside.items()}
    goal = {"goal": entry["goal"]} if "goal" in entry else {}
    return {**goal, **_plain(entry.get("gains")), **_plain(entry.get("margins")), **foreseen}


def _worded(name: str) -> str:
    """Return a name as people write it."""
    bare, comma, rest = name.partition(",")
    return NAMES.get(bare, bare.replace("_", " ")) + comma + rest


def _quantity(name: str, units: Units) -> str:
    """Return the name of a number of the gains, with its unit."""
    return named(_worded(name), units.named(UNITS.get(name.partition(",")[0], "")))


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _pictures(traces: Traces, units: Units) -> Section:
    rows = kept(traces.pv)
    t, pv = traces.t[rows], traces.pv[rows]
    panels = [
        Panel(
            named("PV", units.pv),
            [
                Curve("measured", pv, 0, "dots"),
                Curve("before", traces.before[rows], 1),
                Curve("after", traces.after[rows], 5),
            ],
        ),
        output_panel(traces.output[rows], units.output),
        Panel(
            named("residual", units.pv),
            _both(pv - traces.before[rows], pv - traces.after[rows]),
            120.0,
        ),
    ]
    span = [Span("not fitted", traces.held_out_from_s, float(traces.t[-1]))]
    parts = [Picture(Chart(t, panels, "Measured PV, before and after", span), "The shaded part was not fitted.")]
    return Section("Measured against model", [*parts, *_against(traces, units)])


def _against(traces: Traces, units: Units) -> list[Picture]:
    """Return the residual against output, moves, PV, slope and time, averaged in bins, and its spectrum."""
    before, after = traces.pv - traces.before, traces.pv - traces.after
    moves = np.diff(traces.output, prepend=traces.output[0])
    last = np.maximum.accumulate(np.where(moves != 0.0, np.arange(moves.size), 0))
    looks = {
        "output": traces.output,
        "last move of the output": moves[last],
        "PV": traces.pv,
        "slope of the PV": np.gradient(traces.pv, traces.t),
        "time": traces.t,
    }
    drawn = []
    for name, values in looks.items():
        if np.ptp(values) == 0.0:
            continue
        centres, first = _binned(values, before)
        _, second = _binned(values, after)
        panel = Panel(
            named(f"mean residual against {name}", units.pv),
            [Curve("before", first, 1), Curve("after", second, 5)],
            90.0,
        )
        drawn.append(
            Picture(Chart(centres, [panel], f"Residual against {name}", axis=named(name, units.named(AXES[name]))), "")
        )
    return [*drawn, _spectrum(traces, before, after)]


def _binned(values: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    edges = np.linspace(values.min(), values.max(), BINS + 1)
    at = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, BINS - 1)
    count = np.bincount(at, minlength=BINS)
    total = np.bincount(at, weights=residual, minlength=BINS)
    filled = count > 0
    return ((edges[1:] + edges[:-1]) / 2.0)[filled], (total[filled] / count[filled])


def _spectrum(traces: Traces, before: FloatArray, after: FloatArray) -> Picture:
    even = np.linspace(traces.t[0], traces.t[-1], traces.t.size)
    interval = float(even[1] - even[0])
    frequency: FloatArray = np.fft.rfftfreq(even.size, interval)[1:].astype(np.float64)

    def density(values: FloatArray) -> FloatArray:
        power = np.abs(np.fft.rfft(np.interp(even, traces.t, values) * np.hanning(even.size)))[1:] ** 2
        result: FloatArray = np.log10(power / even.size + SMALLEST_DIVISOR)
        return result

    first, second = density(before), density(after)
    rows = kept(second)
    panel = Panel("log10 power of the residual", _both(first[rows], second[rows]), 110.0)
    return Picture(Chart(frequency[rows], [panel], "Spectrum of the residual", axis="f, Hz"), "")
