"""The report of a tuning: from its result to sections.

Invariants:

1. The input is a tuning's result as data (`TuningRun.to_dict`), so that stored and new tunings are reported alike.
2. Parts without a check are stated in words, whatever the verdict.
"""

from __future__ import annotations

import hashlib
import math
import platform
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from autotuner.core.design import DesignSpec
from autotuner.core.model.process import model_from_dict
from autotuner.reports.choices import basis_from_result, choices_of, installed_from_result
from autotuner.reports.curves import fit_curves
from autotuner.reports.document import Facts, Grid, Picture, Section, Words, document
from autotuner.reports.numbers import named, number, parameter_unit, ratio_unit, with_unit
from autotuner.reports.pictures.chart import (
    Chart,
    Curve,
    Panel,
    Span,
    fit_panels,
    output_panel,
    unfitted_span,
)
from autotuner.reports.verification import sign_off

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from autotuner.core.design.simulation.closed_loop_setup import Installed
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner.reports.document import Part

POINTS = 1500
"""Most points of a curve: a report is to be sent by mail."""
DIGITS = 7
"""Digits of settings: a day in seconds is written out."""
IN_LIMITS = {"output": "output", "pv": "pv", "output_slew_per_s": "output", "safe_output": "output"}
IN_SETTINGS = {"amplitude": "output", "max_amplitude": "output", "pv_amplitude": "pv", "hysteresis": "pv"}
"""Quantities with the unit of a limit or a setting."""
TAIL = "tail"
"""Name of the part of the record that no model is fitted to."""
PACKAGES = ("relay-autotuner", "numpy", "scipy")


@dataclass(frozen=True, slots=True)
class Setting:
    """Location of the tuning.

    Attributes
    ----------
    driver, pv_unit, output_unit : str
        Of the loop.
    extra : sequence of Section
        Further sections, such as a diagnosis.
    spec : DesignSpec
        The requested design.
    fitted_until_s : float or None
        Where the part of the record begins that no model was fitted to, s; None where that is not known.
    """

    driver: str = ""
    pv_unit: str = ""
    output_unit: str = ""
    extra: Sequence[Section] = ()
    spec: DesignSpec = field(default_factory=DesignSpec)
    fitted_until_s: float | None = None


def report(result: Mapping[str, Any], recording: Recording | None, setting: Setting) -> str:
    """Return the report of a tuning as one HTML file.

    Parameters
    ----------
    result : mapping
        The result of the tuning, as of `TuningRun.to_dict`.
    recording : Recording or None
        What it recorded; None before the second sample.
    setting : Setting
        The loop, and further sections.
    """
    model = None if not result.get("model") else model_from_dict(result["model"], result["structure"])
    sections = [
        _verdict(result),
        *([] if model is None else [_gains(result, recording, setting)]),
        *sign_off(result, setting.pv_unit, setting.output_unit),
        *([] if recording is None else [_measured(result, recording, model, setting)]),
        *([] if model is None else [_model(result, setting)]),
        *setting.extra,
        Section("What was not checked", [Words(text) for text in not_checked(result)]),
        _settings(result, setting),
        _origin(result, recording),
    ]
    return document(f"Tuning of {result['loop']}", f"{result['id']}, started {result['started_at']}", sections)


def not_checked(result: Mapping[str, Any]) -> list[str]:
    """Return the parts of this tuning without a check, in words."""
    return [text for applies, text in _NOT_CHECKED if applies(result)]


def _unchecked_part(result: Mapping[str, Any]) -> bool:
    return not result.get("settings", {}).get("check", True) or result.get("error") is None


_NOT_CHECKED: list[tuple[Callable[[Mapping[str, Any]], bool], str]] = [
    (
        _unchecked_part,
        "Dead-band, friction, saturation and the like: no part of the record was held out to detect them.",
    ),
    (
        lambda result: result.get("diagnosis") is None,
        "No diagnosis was made: there was no search for effects that the model lacks.",
    ),
    (
        lambda result: not result.get("verification"),
        "The gains were not verified on the loop: margins and responses are those of the model.",
    ),
    (lambda result: result.get("restored") is not True, "The output was not confirmed at its value before the test."),
    (
        lambda _: True,
        "Other operating points: the gains hold where the test was made; load and throughput change many processes.",
    ),
]


def _verdict(result: Mapping[str, Any]) -> Section:
    verdict = result.get("verdict")
    if verdict is None:
        return Section("Result", [Words("The tuning still runs.")])
    text = f"{verdict['outcome'].capitalize()}: {verdict['message']}. {verdict['remedy']}".strip()
    warnings = [Words(f"Warning: {warning}.", "refused") for warning in result.get("warnings", [])]
    notes = [Words(f"Note: {note}.") for note in result.get("notes", [])]
    return Section("Result", [Words(text, verdict["outcome"]), *warnings, *notes])


def _measured(result: Mapping[str, Any], recording: Recording, model: ProcessModel | None, setting: Setting) -> Section:
    until_s = _fitted_until_s(result, recording, setting)
    curves = fit_curves(recording, model, POINTS, until_s)
    column = {name: np.array(values, dtype=np.float64) for name, values in curves.items() if isinstance(values, list)}
    t, limits = column["t_s"], result.get("settings", {}).get("limits", {})
    output = output_panel(column["output"], setting.output_unit, _limits(limits.get("output")))
    panels = fit_panels(column["pv"], column.get("model"), output, setting.pv_unit, lines=_limits(limits.get("pv")))
    caption = "The shaded parts are the phases of the test."
    unfitted = unfitted_span(recording, until_s)
    if unfitted:
        caption += f" No model was fitted from {number(until_s)} s on: there the model is a prediction."
    beside = _effects_beside(result)
    if beside:
        caption += f" The model here is the process alone, without {beside}."
    spans = [*_spans(recording), *unfitted]
    drawn = Chart(t, panels, "Measured PV against the model, the output, and the residual", spans)
    return Section("Measured against model", [Picture(drawn, caption)])


def _effects_beside(result: Mapping[str, Any]) -> str:
    """Return the effects that belong to the recommended process and are not drawn with it; empty without any."""
    found = result["diagnosis"]["effects"] if result.get("recommended") == "diagnosis" else []
    return " and ".join(effect["name"].replace("_", " ") for effect in found)


def _fitted_until_s(result: Mapping[str, Any], recording: Recording, setting: Setting) -> float:
    """Return where the fitted part ends, s; of a tuning that has not reported it, where its last part begins."""
    if setting.fitted_until_s is not None:
        return setting.fitted_until_s
    return recording.segments.get(TAIL, math.inf) if result.get("error") else math.inf


def _limits(pair: Sequence[float | None] | None) -> list[tuple[float, str]]:
    return [
        (value, f"{what} limit")
        for value, what in zip(pair or (), ("lower", "upper"), strict=False)
        if value is not None
    ]


def _spans(recording: Recording) -> list[Span]:
    begins = sorted(recording.segments.items(), key=lambda item: item[1])
    ends = [*(start for _, start in begins[1:]), float(recording.t[-1])]
    return [Span(name.replace("_", " "), start, end) for (name, start), end in zip(begins, ends, strict=False)]


def _model(result: Mapping[str, Any], setting: Setting) -> Section:
    best = result["estimates"].get(result["recommended"], {})
    intervals = best.get("interval95", {})
    rows = [
        [
            named(name, parameter_unit(name, result["structure"], setting.pv_unit, setting.output_unit)),
            number(value),
            " to ".join(number(edge) for edge in intervals.get(name, ())) or "not known",
        ]
        for name, value in result["model"].items()
    ]
    methods = [
        [name.replace("_", " "), _parameters(estimate, setting), _percent(estimate["fit_percent"])]
        for name, estimate in result["estimates"].items()
    ]
    fit, error = result["fit"], result.get("error") or {}
    return Section(
        f"Model: {result['structure'].replace('_', ' ')}",
        [
            Grid("The recommended model", ["parameter, unit", "value", "95 % interval"], rows),
            Facts([
                ("fit", f"{number(fit['fit_percent'], 3)} %"),
                ("error, root mean square", with_unit(number(fit["rmse"], 3), setting.pv_unit)),
                ("noise, standard deviation", with_unit(number(fit["noise_sigma"], 3), setting.pv_unit)),
                ("error where not fitted", with_unit(number(error.get("held_out"), 3), setting.pv_unit)),
                *_cycle(result, setting),
            ]),
            Grid("Each method", ["method", "parameters", "fit"], methods),
        ],
    )  # fmt: skip


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{number(value, 3)} %"


def _parameters(estimate: Mapping[str, Any], setting: Setting) -> str:
    if not estimate["model"]:
        return str(estimate["refusal"] or "does not apply")
    units = (setting.pv_unit, setting.output_unit)
    structure = estimate.get("structure") or ""
    return ", ".join(
        f"{name} {with_unit(number(value), parameter_unit(name, structure, *units))}"
        for name, value in estimate["model"].items()
    )


def _cycle(result: Mapping[str, Any], setting: Setting) -> list[tuple[str, str]]:
    cycle = result.get("limit_cycle")
    if not cycle:
        return []
    gain = ratio_unit(setting.output_unit, setting.pv_unit)
    return [
        ("period Pu", f"{number(cycle['Pu'])} s"),
        ("amplitude A", with_unit(number(cycle["A"]), setting.pv_unit)),
        ("ultimate gain Ku", with_unit(number(cycle["Ku"]), gain)),
    ]


def _gains(result: Mapping[str, Any], recording: Recording | None, setting: Setting) -> Section:
    basis, installed = basis_from_result(result, recording), installed_from_result(result, recording)
    choices = choices_of(basis, setting.spec, installed)
    rows = [[str(choice["name"]), *_row(choice)] for choice in choices]
    gain = ratio_unit(setting.output_unit, setting.pv_unit)
    head = [
        "", "", named("Kp", gain), "Ti, s", "Td, s", "Ms", "gain margin", "phase margin", "overshoot", "settles",
        named("output noise", setting.output_unit),
    ]  # fmt: skip
    parts: list[Part] = _chosen(choices, result, setting)
    numbers = [
        [choice["name"], *(f"{label} {number(value, 6)}" for label, value in choice["device"]["values"].items())]
        for choice in choices
        if choice["device"]
    ]
    inside: list[Part] = (
        [Grid("As the device states them, by goal", [""] * len(numbers[0]), numbers)] if numbers else []
    )
    pictures: list[Part] = [] if not choices else [_responses(choices, installed, setting)]
    advice = (result.get("tuning") or {}).get("advice")
    advised = [Words(f"Controller advised: {advice['text']}.")] if advice else []
    ideal: list[Part] = [Grid("Ideal form, by goal", head, rows), Words(controller_words(choices)), *advised]
    return Section("Gains", [*parts, *inside, *ideal, *pictures])


def _chosen(choices: Sequence[Mapping[str, Any]], result: Mapping[str, Any], setting: Setting) -> list[Part]:
    """Return the gains to use: as the device states them, and in the ideal form with units."""
    chosen = result.get("tuning") or {}
    name = chosen.get("goal") or chosen.get("rule")
    choice = next((one for one in choices if one["name"] == setting.spec.name), None)
    if choice is None:
        return [Words(f"Requested: {name}.")] if name else []
    held = choice["device"] or choice
    gains = held["gains"]
    overshoot, predicted = choice["overshoot"], choice["predicted"] or {}
    stated = [(f"{label} in the device", number(value, 6)) for label, value in (held.get("values") or {}).items()]
    facts = [
        ("goal", str(choice["name"])),
        *stated,
        ("Kp", with_unit(number(gains["Kp"], 5), ratio_unit(setting.output_unit, setting.pv_unit))),
        ("Ti", "none" if gains["Ti"] is None else f"{number(gains['Ti'], 5)} s"),
        ("Td", f"{number(gains['Td'], 5)} s"),
        ("set-point weight b", number(gains["b"], 3)),
        ("overshoot, predicted", "–" if overshoot is None else f"{number(100.0 * overshoot, 3)} %"),
        ("settles, predicted", f"{number(predicted.get('settling_time_s'), 3)} s"),
    ]
    return [Facts(facts)]


def controller_words(choices: Sequence[Mapping[str, Any]]) -> str:
    """Return the controller that margins and responses are predicted for, in a sentence."""
    if not choices:
        return "No goal has gains for this process."
    gains = (choices[0]["device"] or choices[0])["gains"]
    whose = "the controller in the device" if choices[0]["device"] else "a controller that holds the whole design"
    filters = [f"a derivative filter Td/{number(gains['N'])}"] if gains.get("N") else []
    filters += [f"a measurement filter Tf {number(gains['Tf'])} s"] if gains["Tf"] else []
    return (
        f"Predicted for {whose}: set-point weight b {number(gains['b'])}, "
        f"{' and '.join(filters) or 'no filter'}. "
        "Output noise is the standard deviation that the measured noise causes."
    )


def _row(choice: Mapping[str, Any]) -> list[str]:
    held = choice["device"] or choice
    gains, margins = held["gains"], choice["margins"] or {}
    overshoot = choice["overshoot"]
    return [
        gains["controller"],
        *(number(gains[name]) for name in ("Kp", "Ti", "Td")),
        *(number(margins.get(name), 3) for name in ("Ms", "gain_margin")),
        f"{number(margins.get('phase_margin_deg'), 3)}°",
        "–" if overshoot is None else f"{number(100.0 * overshoot, 2)} %",
        f"{number((choice['predicted'] or {}).get('settling_time_s'), 3)} s",
        number(choice["jitter"], 2),
    ]


def _responses(choices: Sequence[Mapping[str, Any]], installed: Installed, setting: Setting) -> Picture:
    t = np.array(choices[0]["responses"]["t_s"], dtype=np.float64)

    def curves(part: str) -> list[Curve]:
        return [
            Curve(choice["name"], np.array(choice["responses"][part], dtype=np.float64), (5, 0, 2, 4)[k % 4])
            for k, choice in enumerate(choices)
        ]

    step = with_unit(number(installed.set_point_step), setting.pv_unit)
    load = with_unit(number(installed.load_step), setting.output_unit)
    panels = [
        Panel(named(f"PV after a step of the set point by {step}", setting.pv_unit), curves("step_pv"), 150.0),
        Panel(named(f"PV after a step of the load by {load}", setting.pv_unit), curves("load_pv"), 130.0),
    ]
    beside = "".join(f", with {name.replace('_', ' ')}" for name in installed.foreseen)
    caption = f"Predicted on the model{beside}, within the output's limits; deviations from rest."
    return Picture(Chart(t, panels, "Predicted responses"), caption)


def _settings(result: Mapping[str, Any], setting: Setting) -> Section:
    given = result.get("settings", {})
    test = {name: value for name, value in given.items() if name != "limits"}
    before = result.get("before") or {}
    restored = result.get("restored")
    found = [
        ("driver", setting.driver or "–"),
        ("samples", str(result.get("samples"))),
        ("output before", with_unit(number(before.get("output")), setting.output_unit)),
        ("restored", "not known" if restored is None else _plain(restored)),
    ]
    parts: list[Part] = [
        Facts(found),
        Words("Limits kept on every write:"),
        _facts(given.get("limits", {}), IN_LIMITS, setting),
        Words("Settings of the test:"),
        _facts(test, IN_SETTINGS, setting),
    ]
    return Section("Settings and safety limits", parts, folded=True)


def _facts(values: Mapping[str, Any], quantities: Mapping[str, str], setting: Setting) -> Facts:
    """Return settings with their units; those in seconds and shares name theirs."""
    units = {"pv": setting.pv_unit, "output": setting.output_unit}
    rows = []
    for name, value in values.items():
        text = _plain(value)
        unit = units.get(quantities.get(name, ""), "") if text != "none" else ""
        rows.append((name.replace("_", " "), with_unit(text, unit)))
    return Facts(rows)


def _plain(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return "none" if all(part is None for part in value) else " to ".join(_plain(part) for part in value)
    return number(value, DIGITS) if isinstance(value, int | float) else str(value)


def _origin(result: Mapping[str, Any], recording: Recording | None) -> Section:
    rows = [(name, version(name)) for name in PACKAGES] + [("Python", platform.python_version())]
    if recording is not None:
        rows.append(("SHA-256 of the recording as CSV", recording_hash(recording)))
    return Section("Origin", [Facts([("tuning", str(result["id"])), *rows])])


def recording_hash(recording: Recording) -> str:
    """Return the SHA-256 of a recording as the CSV text that the service and `--recording` give, in hex."""
    return hashlib.sha256(recording.to_csv().encode()).hexdigest()
