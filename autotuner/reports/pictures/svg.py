"""A chart as SVG text, for a report that is one file.

Invariants:

1. A picture is text of numbers and escaped words: it contains no script and loads nothing.
2. Colours are classes (`c0`, `c1`, ...) of the report's style sheet, so that a report prints in black on white and
   reads in the dark; a picture without that style sheet is still legible.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from autotuner.reports.pictures.chart import COLOURS, LIMIT_COLOUR, UNFITTED_COLOUR

if TYPE_CHECKING:
    from collections.abc import Iterable

    from autotuner.core.model.arrays import FloatArray
    from autotuner.reports.pictures.chart import Chart, Curve, Panel, Span

WIDTH, LEFT, RIGHT, TOP, BOTTOM, GAP = 900.0, 64.0, 10.0, 30.0, 34.0, 30.0
"""Sizes of a picture, its own units."""
CHARACTER = 7.0
"""Width of a character, the same units."""


def svg(chart: Chart) -> str:
    """Return a chart as an `<svg>` element."""
    t, panels = chart.t, chart.panels
    height = TOP + BOTTOM + sum(panel.height for panel in panels) + GAP * (len(panels) - 1)
    across = _Across(float(t[0]), float(t[-1]))
    parts = [*_spans(across, chart.spans, height - BOTTOM)]
    top = TOP
    for panel in panels:
        parts += _panel(across, t, panel, top)
        top += panel.height + GAP
    parts += _time_axis(across, height - BOTTOM, chart.axis)
    return (
        f'<svg viewBox="0 0 {WIDTH:g} {height:g}" role="img" aria-label="{escape(chart.title)}" '
        f'xmlns="http://www.w3.org/2000/svg">{"".join(parts)}</svg>'
    )


@dataclass(frozen=True, slots=True)
class _Across:
    """The time axis."""

    start: float
    end: float

    def x(self, t: FloatArray | float) -> FloatArray:
        span = self.end - self.start or 1.0
        return LEFT + (np.asarray(t, dtype=np.float64) - self.start) / span * (WIDTH - LEFT - RIGHT)


def _spans(across: _Across, spans: Iterable[Span], bottom: float) -> Iterable[str]:
    for number, span in enumerate(spans):
        left, right = float(across.x(span.start_s)), float(across.x(span.end_s))
        if span.kind:
            yield f'<rect x="{left:.1f}" y="{TOP:g}" width="{right - left:.1f}" height="{bottom - TOP:g}" '
            yield f'fill="{UNFITTED_COLOUR}" fill-opacity="0.14"/>'
            yield f'<path class="grid" d="M{left:.1f} {TOP:g}V{bottom:g}" '
            yield f'stroke="{UNFITTED_COLOUR}" stroke-dasharray="4 3"/>'
            yield _text(right - 3.0, bottom - 4.0, span.name, "end")
            continue
        yield f'<rect class="span{number % 2}" x="{left:.1f}" y="{TOP:g}" width="{right - left:.1f}" '
        yield f'height="{bottom - TOP:g}" fill="#888" fill-opacity="0.1"/>'
        if right - left > 7.0 * len(span.name):
            yield _text(left + 3.0, TOP - 5.0, span.name)


def _panel(across: _Across, t: FloatArray, panel: Panel, top: float) -> Iterable[str]:
    low, high = _range(panel)
    bottom = top + panel.height

    def y(value: FloatArray | float) -> FloatArray:
        return bottom - (np.asarray(value, dtype=np.float64) - low) / (high - low) * panel.height

    for value, shown in ticks(low, high, max(3, int(panel.height / 40.0))):
        at = float(y(value))
        yield f'<path class="grid" d="M{LEFT:g} {at:.1f}H{WIDTH - RIGHT:g}" stroke="#ccc" fill="none"/>'
        yield _text(LEFT - 6.0, at + 4.0, shown, "end")
    for value, label in panel.lines:
        if low <= value <= high:
            at = float(y(value))
            yield f'<path class="limit" d="M{LEFT:g} {at:.1f}H{WIDTH - RIGHT:g}" '
            yield f'stroke="{LIMIT_COLOUR}" stroke-dasharray="5 4" fill="none"/>'
            yield _text(WIDTH - RIGHT - 4.0, at - 4.0, label, "end")
    for curve in panel.curves:
        yield _curve(across.x(t), y(curve.values), curve)
    yield _text(2.0, top - (20.0 if top == TOP else 8.0), panel.title)
    yield from _legend(panel, top)


def _legend(panel: Panel, top: float) -> Iterable[str]:
    x = WIDTH - RIGHT
    for curve in reversed([curve for curve in panel.curves if curve.label]):
        yield f'<text class="k{curve.colour}" x="{x:.0f}" y="{top - (20.0 if top == TOP else 8.0):g}" font-size="12" '
        yield f'text-anchor="end" fill="{COLOURS[curve.colour]}">{escape(curve.label)}</text>'
        x -= 7.0 * len(curve.label) + 16.0


def _curve(x: FloatArray, y: FloatArray, curve: Curve) -> str:
    colour = COLOURS[curve.colour]
    if curve.kind == "dots":
        dots = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x, y, strict=True) if math.isfinite(b))
        return (
            f'<path class="c{curve.colour}" d="{dots}" stroke="{colour}" stroke-width="2.4" '
            'stroke-linecap="round" stroke-opacity="0.55" fill="none"/>'
        )
    drawn, path = False, []
    for a, b in zip(x, y, strict=True):
        if not math.isfinite(b):
            drawn = False
        elif not drawn:
            path.append(f"M{a:.1f} {b:.1f}")
            drawn = True
        else:
            path.append(f"H{a:.1f}V{b:.1f}" if curve.kind == "step" else f"L{a:.1f} {b:.1f}")
    return (
        f'<path class="c{curve.colour}" d="{"".join(path)}" stroke="{colour}" stroke-width="1.4" '
        'stroke-linejoin="round" fill="none"/>'
    )


def _time_axis(across: _Across, bottom: float, axis: str) -> Iterable[str]:
    for value, shown in ticks(across.start, across.end, 9):
        x = float(across.x(value))
        yield f'<path class="grid" d="M{x:.1f} {bottom:g}v5" stroke="#888" fill="none"/>'
        if x < WIDTH - RIGHT - CHARACTER * (len(axis) + 2):
            yield _text(x, bottom + 18.0, shown, "middle")
    yield _text(WIDTH - RIGHT, bottom + 18.0, axis, "end")


def _text(x: float, y: float, text: str, anchor: str = "start") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="12" text-anchor="{anchor}" fill="currentColor">{escape(text)}</text>'
    )


def _range(panel: Panel) -> tuple[float, float]:
    found = [values for curve in panel.curves if (values := curve.values[np.isfinite(curve.values)]).size]
    low = min((float(values.min()) for values in found), default=0.0)
    high = max((float(values.max()) for values in found), default=1.0)
    span = high - low or 0.1 * max(abs(high), 1.0)
    near = [value for value, _ in panel.lines if low - span <= value <= high + span]
    low, high = min([low, *near]), max([high, *near])
    edge = 0.06 * (high - low or span)
    return low - edge, high + edge


def ticks(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """Return round numbers between two, at most about `most`, with texts of equal precision."""
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= 0.999 * raw)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    numbers = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    return [(k * step, f"{k * step:.{decimals}f}") for k in numbers]
