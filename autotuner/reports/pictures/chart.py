"""What a picture shows: panels of curves, one above the other, over one axis; how it is drawn is said elsewhere."""

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
"""Colours of curves by their number: distinct in print, and for people who see red and green alike."""
MEASURED, MODEL, OUTPUT, RESIDUAL = 0, 1, 2, 3
"""Numbers of the colours of a record's curves."""


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
    """A stretch of time that is shaded and named, s; one that was not fitted has a colour of its own."""

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
        Times, s, rising; or what `axis` names.
    panels : sequence of Panel
        From top to bottom; every curve has N values.
    title : str
        What the picture shows, for those who cannot see it.
    spans : sequence of Span
        Stretches of time.
    axis : str
        What `t` is, where it is no time.
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
    drawn = [Curve("measured", recording.pv, MEASURED, "dots")]
    residual = []
    if identification.model is not None:
        simulated = simulate_fit(identification.model, recording, until_s)
        drawn.append(Curve(f"model ({identification.structure})", simulated, MODEL))
        curve = Curve("measured less model", recording.pv - simulated, RESIDUAL)
        residual = [Panel(named("residual", pv_unit), [curve], 90.0)]
    panels = [Panel(named("PV", pv_unit), drawn), output_panel(recording.output, output_unit), *residual]
    return Chart(recording.t, panels, "Measured PV against the model", unfitted_span(recording, until_s))


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
