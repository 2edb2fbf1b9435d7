"""The content of a picture: panels of curves, one above the other, over one axis; other modules draw it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from autotuner.core.identification import simulate_fit
from autotuner.reports.numbers import named

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.identification import Identification
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Recording

COLOURS = ("#0b6e8a", "#c2185b", "#c25a00", "#4a6d0c", "#7a5195", "#2e7d52")
"""Colours of curves by their number, distinct in print and with red-green colour blindness."""
MEASURED, MODEL, OUTPUT, RESIDUAL = 0, 1, 2, 3
"""Numbers of the colours of a record's curves."""
LIMIT_COLOUR, UNFITTED_COLOUR = "#b3261e", "#b07a00"
"""Colours of limits, and of parts that no model was fitted to."""


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A curve: a `label` for the legend, values of shape (N,), and how it is drawn; NaN breaks it."""

    label: str
    values: FloatArray
    colour: int = 0
    kind: Literal["line", "step", "dots"] = "line"


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """Curves with one axis; `height` in px; `lines` are levels with a label, such as limits."""

    title: str
    curves: Sequence[Curve]
    height: float = 200.0
    lines: Sequence[tuple[float, str]] = ()


@dataclass(frozen=True, slots=True)
class Span:
    """A shaded and named time interval, s; an interval that was not fitted has its own colour."""

    name: str
    start_s: float
    end_s: float
    kind: Literal["", "unfitted"] = ""


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A picture.

    Parameters
    ----------
    t : array of float, shape (N,)
        Times, s, ascending; or values of `axis`.
    panels : sequence of Panel
        From top to bottom; every curve has N values.
    title : str
        Description of the picture for screen readers.
    spans : sequence of Span
        Stretches of time.
    axis : str
        Quantity of `t`, where it is not time.
    """

    t: FloatArray
    panels: Sequence[Panel]
    title: str
    spans: Sequence[Span] = ()
    axis: str = "t, s"


def fit_chart(recording: Recording, identification: Identification, pv_unit: str, output_unit: str) -> Chart:
    """Return a whole record with its model: PV, output, residual, and the part that was not fitted."""
    fitted = identification.recording or recording
    until_s = float(fitted.t[-1])
    recording = fitted if identification.disturbances else recording
    model = identification.model
    simulated = None if model is None else simulate_fit(model, recording, until_s)
    output, name = output_panel(recording.output, output_unit), f"model ({identification.structure})"
    panels = fit_panels(recording.pv, simulated, output, pv_unit, name)
    return Chart(recording.t, panels, "Measured PV against the model", unfitted_span(recording, until_s))


def fit_panels(
    pv: FloatArray,
    simulated: FloatArray | None,
    output: Panel,
    pv_unit: str,
    name: str = "model",
    lines: Sequence[tuple[float, str]] = (),
) -> list[Panel]:
    """Return the panels of a record with its model: PV, output, residual.

    Parameters
    ----------
    pv, simulated : array of float, shape (N,)
        Measured PV and that of the model, PV units; None without a model.
    output : Panel
        The output.
    pv_unit : str
        Unit of the PV.
    name : str
        What the model is called.
    lines : sequence of (float, str)
        Levels of the PV with their labels.
    """
    measured = Curve("measured", pv, MEASURED, "dots")
    if simulated is None:
        return [Panel(named("PV", pv_unit), [measured], lines=lines), output]
    residual = Curve("measured less model", pv - simulated, RESIDUAL)
    return [
        Panel(named("PV", pv_unit), [measured, Curve(name, simulated, MODEL)], lines=lines),
        output,
        Panel(named("residual", pv_unit), [residual], 90.0),
    ]


def record_chart(recording: Recording, pv_unit: str = "", output_unit: str = "") -> Chart:
    """Return a record without a model: PV and output."""
    measured = Panel(named("PV", pv_unit), [Curve("", recording.pv, MEASURED)])
    return Chart(recording.t, [measured, output_panel(recording.output, output_unit)], "PV and output")


def output_panel(output: FloatArray, unit: str, lines: Sequence[tuple[float, str]] = ()) -> Panel:
    """Return the panel of an output, which is held between two samples."""
    return Panel(named("output", unit), [Curve("output", output, OUTPUT, "step")], 110.0, lines)


def unfitted_span(recording: Recording, until_s: float = math.inf) -> list[Span]:
    """Return the part of a record that no model was fitted to, as a span; none where all of it was."""
    end_s = float(recording.t[-1])
    return [Span("not fitted", until_s, end_s, "unfitted")] if until_s < end_s else []
