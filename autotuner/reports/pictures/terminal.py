"""A chart as characters, for a terminal."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import plotext

if TYPE_CHECKING:
    from autotuner.reports.pictures.chart import Chart

WIDEST = 110
"""Most columns of a chart: wider ones are no easier to read."""
PLAIN = str.maketrans("┌┐└┘├┤┬┴┼─│", "+++++++++-|")
"""Frames for an encoding that has none."""
POINTS = 2000
"""Most points drawn: a terminal shows two a column."""
LINE = 14.0
"""Height of a line of characters, px."""


def text(chart: Chart, width: int) -> str:
    """Return the picture as lines of text, coloured only for a terminal."""
    thin = slice(None, None, max(chart.t.size // POINTS, 1))
    t = chart.t[thin].tolist()
    unicode = (sys.stdout.encoding or "").lower().startswith("utf")
    plotext.main().clear_figure()
    plotext.theme("clear")
    plotext.subplots(len(chart.panels), 1)
    for row, panel in enumerate(chart.panels, start=1):
        plotext.subplot(row, 1)
        plotext.plot_size(min(width, WIDEST), round(panel.height / LINE))
        plotext.title(panel.title)
        for curve in panel.curves:
            plotext.plot(t, curve.values[thin].tolist(), marker="braille" if unicode else "*")
    plotext.xlabel(chart.axis)
    drawn: str = plotext.build()
    if not unicode:
        drawn = drawn.translate(PLAIN)
    return drawn if sys.stdout.isatty() else plotext.uncolorize(drawn)
