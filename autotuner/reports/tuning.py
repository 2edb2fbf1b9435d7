"""The report of a tuning: from what is told of it to sections.

Rules of this file:

1. It works on what a tuning tells as data (`Tuning.to_dict`), so that one from the store is reported as a fresh one.
2. What was not checked is said in words, whatever the verdict.
"""

from __future__ import annotations

import hashlib
import platform
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from autotuner.core.process import model_from_dict
from autotuner.core.tuning import Wish
from autotuner.reports.choices import OnOffer, basis_told, choices_of, installed_told, offers_of
from autotuner.reports.curves import fit_curves
from autotuner.reports.document import Facts, Grid, Picture, Section, Words, document
from autotuner.reports.svg import Curve, Panel, Span, picture

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from autotuner.core.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner.core.tuning.installed import Installed

POINTS = 1500
"""Most points of a curve: a report is to be sent by mail."""
DIGITS = 7
"""Of settings: a day in seconds is written out."""
PACKAGES = ("relay-autotuner", "numpy", "scipy")


@dataclass(frozen=True, slots=True)
class Setting:
    """Where it was done.

    Attributes
    ----------
    driver, pv_unit, output_unit : str
        Of the loop.
    extra : sequence of Section
        Further sections, such as a diagnosis.
    wish : Wish
        What was asked of the gains.
    on_offer : OnOffer or None
        The gains that can be chosen; None for those that the process has, without a device.
    """

    driver: str = ""
    pv_unit: str = ""
    output_unit: str = ""
    extra: Sequence[Section] = ()
    wish: Wish = field(default_factory=Wish)
    on_offer: OnOffer | None = None


def report(told: Mapping[str, Any], recording: Recording | None, setting: Setting) -> str:
    """Return the report of a tuning as one HTML file.

    Parameters
    ----------
    told : mapping
        What the tuning tells, as `Tuning.to_dict` does.
    recording : Recording or None
        What it recorded; None before the second sample.
    setting : Setting
        The loop, and further sections.
    """
    model = None if not told.get("model") else model_from_dict(told["model"], told["structure"])
    sections = [
        _verdict(told),
        *([] if recording is None else [_measured(told, recording, model, setting)]),
        *([] if model is None else [_model(told, setting), _gains(told, recording, setting)]),
        *setting.extra,
        Section("What was not checked", [Words(text) for text in not_checked(told)]),
        _settings(told, setting),
        _origin(told, recording),
    ]
    return document(f"Tuning of {told['loop']}", f"{told['id']}, started {told['started_at']}", sections)


def not_checked(told: Mapping[str, Any]) -> list[str]:
    """Return, in words, what this tuning cannot vouch for."""
    return [text for applies, text in _NOT_CHECKED if applies(told)]


def _unchecked_part(told: Mapping[str, Any]) -> bool:
    return not told.get("settings", {}).get("check", True) or told.get("error") is None


_NOT_CHECKED: list[tuple[Callable[[Mapping[str, Any]], bool], str]] = [
    (
        _unchecked_part,
        "Dead-band, friction, saturation and the like: no part of the record was kept from the fit to show them.",
    ),
    (
        lambda told: told.get("diagnosis") is None,
        "No diagnosis was made: effects that the model lacks were not looked for by name.",
    ),
    (
        lambda told: not told.get("verification"),
        "The gains were not verified on the loop: margins and responses are those of the model.",
    ),
    (lambda told: told.get("restored") is not True, "The output was not confirmed at its value before the test."),
    (
        lambda _: True,
        "Other operating points: the gains hold where the test was made; load and throughput change many processes.",
    ),
]


def number(value: object, digits: int = 4) -> str:
    """Return a number with so many digits; an en dash for none."""
    return f"{value:.{digits}g}" if isinstance(value, int | float) and np.isfinite(value) else "–"


def _with(unit: str, text: str) -> str:
    return f"{text} {unit}".rstrip()


def _verdict(told: Mapping[str, Any]) -> Section:
    verdict = told.get("verdict")
    if verdict is None:
        return Section("Result", [Words("The tuning still runs.")])
    text = f"{verdict['outcome'].capitalize()}: {verdict['message']}. {verdict['remedy']}".strip()
    warnings = [Words(f"Warning: {warning}.", "refused") for warning in told.get("warnings", [])]
    return Section("Result", [Words(text, verdict["outcome"]), *warnings])


def _measured(told: Mapping[str, Any], recording: Recording, model: ProcessModel | None, setting: Setting) -> Section:
    curves = fit_curves(recording, model, POINTS)
    column = {name: np.array(values, dtype=np.float64) for name, values in curves.items() if isinstance(values, list)}
    t, limits = column["t_s"], told.get("settings", {}).get("limits", {})
    simulated = [Curve("model", column["model"], 1)] if "model" in column else []
    panels = [
        Panel(
            _named("PV", setting.pv_unit),
            [Curve("measured", column["pv"], 0, "dots"), *simulated],
            lines=_limits(limits.get("pv")),
        ),
        Panel(
            _named("output", setting.output_unit),
            [Curve("output", column["output"], 2, "step")],
            110.0,
            _limits(limits.get("output")),
        ),
    ]
    if "residual" in column:
        panels.append(
            Panel(_named("residual", setting.pv_unit), [Curve("measured less model", column["residual"], 3)], 90.0)
        )
    drawn = picture(t, panels, "Measured PV against the model, the output, and the residual", _spans(recording))
    return Section("Measured against model", [Picture(drawn, "The shaded parts are the phases of the test.")])


def _named(name: str, unit: str) -> str:
    return f"{name}, {unit}" if unit else name


def _limits(pair: Sequence[float | None] | None) -> list[tuple[float, str]]:
    return [
        (value, f"{what} limit")
        for value, what in zip(pair or (), ("lower", "upper"), strict=False)
        if value is not None
    ]


def _spans(recording: Recording) -> list[Span]:
    segments = recording.settings.get("segments")
    begins = sorted(segments.items(), key=lambda item: item[1]) if isinstance(segments, dict) else []
    ends = [*(start for _, start in begins[1:]), float(recording.t[-1])]
    return [Span(name.replace("_", " "), start, end) for (name, start), end in zip(begins, ends, strict=False)]


def _model(told: Mapping[str, Any], setting: Setting) -> Section:
    best = told["estimates"].get(told["recommended"], {})
    intervals = best.get("interval95", {})
    rows = [
        [name, number(value), " to ".join(number(edge) for edge in intervals.get(name, ())) or "not known"]
        for name, value in told["model"].items()
    ]
    methods = [
        [name.replace("_", " "), _parameters(estimate), _percent(estimate["fit_percent"])]
        for name, estimate in told["estimates"].items()
    ]
    fit, error = told["fit"], told.get("error") or {}
    return Section(
        f"Model: {told['structure'].replace('_', ' ')}",
        [
            Grid("Gains in PV/output, times in s", ["", "value", "95 % interval"], rows),
            Facts([
                ("fit", f"{number(fit['fit_percent'], 3)} %"),
                ("error, root mean square", _with(setting.pv_unit, number(fit["rmse"], 3))),
                ("noise, standard deviation", _with(setting.pv_unit, number(fit["noise_sigma"], 3))),
                ("error where not fitted", _with(setting.pv_unit, number(error.get("held_out"), 3))),
                *_cycle(told, setting),
            ]),
            Grid("What each method says", ["method", "parameters", "fit"], methods),
        ],
    )  # fmt: skip


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{number(value, 3)} %"


def _parameters(estimate: Mapping[str, Any]) -> str:
    if not estimate["model"]:
        return str(estimate["refusal"] or "does not apply")
    return ", ".join(f"{name} {number(value)}" for name, value in estimate["model"].items())


def _cycle(told: Mapping[str, Any], setting: Setting) -> list[tuple[str, str]]:
    cycle = told.get("limit_cycle")
    if not cycle:
        return []
    amplitude = _with(setting.pv_unit, number(cycle["A"]))
    return [("period Pu", f"{number(cycle['Pu'])} s"), ("amplitude A", amplitude), ("Ku", number(cycle["Ku"]))]


def _gains(told: Mapping[str, Any], recording: Recording | None, setting: Setting) -> Section:
    chosen, basis = told.get("tuning") or {}, basis_told(told, recording)
    on_offer = setting.on_offer or OnOffer(offers_of(basis, setting.wish))
    installed = installed_told(told, recording, on_offer.derivative_filter)
    choices = choices_of(basis, on_offer, installed)
    rows = [[str(choice["name"]), *_row(choice)] for choice in choices]
    head = ["", "", "Kp", "Ti, s", "Td, s", "Ms", "gain margin", "phase margin", "overshoot", "output jitter"]
    recommended = chosen.get("goal") or chosen.get("rule")
    parts = [Words(f"Asked for: {recommended}.")] if recommended else []
    numbers = [
        [name, *(f"{label} {number(value, 6)}" for label, value in held.labelled.items())]
        for name, held in on_offer.held.items()
    ]
    inside = [Grid("As the device states them", [""] * len(numbers[0]), numbers)] if numbers else []
    pictures = [] if not choices else [_responses(choices, installed, setting)]
    return Section("Gains", [*parts, Grid("Ideal form, by goal", head, rows), *inside, *pictures])


def _row(choice: Mapping[str, Any]) -> list[str]:
    gains, margins = choice["gains"], choice["margins"] or {}
    overshoot = choice["overshoot"]
    return [
        gains["controller"],
        *(number(gains[name]) for name in ("Kp", "Ti", "Td")),
        *(number(margins.get(name), 3) for name in ("Ms", "gain_margin")),
        f"{number(margins.get('phase_margin_deg'), 3)}°",
        "–" if overshoot is None else f"{number(100.0 * overshoot, 2)} %",
        number(choice["jitter"], 2),
    ]


def _responses(choices: Sequence[Mapping[str, Any]], installed: Installed, setting: Setting) -> Picture:
    t = np.array(choices[0]["responses"]["t_s"], dtype=np.float64)

    def curves(part: str) -> list[Curve]:
        return [
            Curve(choice["name"], np.array(choice["responses"][part], dtype=np.float64), (5, 0, 2, 4)[k % 4])
            for k, choice in enumerate(choices)
        ]

    step = _with(setting.pv_unit, number(installed.set_point_step))
    load = _with(setting.output_unit, number(installed.load_step))
    panels = [
        Panel(_named(f"PV after a step of the set point by {step}", setting.pv_unit), curves("step_pv"), 150.0),
        Panel(_named(f"PV after a step of the load by {load}", setting.pv_unit), curves("load_pv"), 130.0),
    ]
    beside = "".join(f", with {name.replace('_', ' ')}" for name in installed.foreseen)
    caption = f"Predicted on the model{beside}, within the output's limits; deviations from rest."
    return Picture(picture(t, panels, "Predicted responses"), caption)


def _settings(told: Mapping[str, Any], setting: Setting) -> Section:
    given = told.get("settings", {})
    limits = given.get("limits", {})
    shown = [(name.replace("_", " "), _plain(value)) for name, value in given.items() if name != "limits"]
    safety = [(name.replace("_", " "), _plain(value)) for name, value in limits.items()]
    before = told.get("before") or {}
    found = [
        ("driver", setting.driver or "–"),
        ("samples", str(told.get("samples"))),
        ("output before", _with(setting.output_unit, number(before.get("output")))),
        ("given back", "not known" if (given_back := told.get("restored")) is None else _plain(given_back)),
    ]
    kept, test = Words("Limits kept on every write:"), Words("Settings of the test:")
    return Section("Settings and safety limits", [Facts(found), kept, Facts(safety), test, Facts(shown)])


def _plain(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return "none" if all(part is None for part in value) else " to ".join(_plain(part) for part in value)
    return number(value, DIGITS) if isinstance(value, int | float) else str(value)


def _origin(told: Mapping[str, Any], recording: Recording | None) -> Section:
    rows = [(name, version(name)) for name in PACKAGES] + [("Python", platform.python_version())]
    if recording is not None:
        rows.append(("SHA-256 of the recording as CSV", recording_hash(recording)))
    return Section("Origin", [Facts([("tuning", str(told["id"])), *rows])])


def recording_hash(recording: Recording) -> str:
    """Return the SHA-256 of a recording as the CSV text that the service and `--recording` give, in hex."""
    return hashlib.sha256(recording.to_csv().encode()).hexdigest()
