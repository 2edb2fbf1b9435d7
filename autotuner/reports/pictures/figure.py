"""A chart as a figure of matplotlib: for a file (PNG, SVG, PDF) and for a notebook."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING

import matplotlib as mpl
from matplotlib.figure import Figure

from autotuner.reports.pictures.chart import COLOURS, LIMIT_COLOUR, UNFITTED_COLOUR

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes

    from autotuner.reports.pictures.chart import Chart, Panel

SCREEN_DPI, FILE_DPI = 80, 120
"""Resolution in a notebook and in a file, dots an inch: a figure is ten inches wide."""
INCH = 100.0
"""Height of a panel that is an inch in a figure, px."""


class Drawing(Figure):
    """A figure that a notebook shows without a setting for inline pictures."""

    def _repr_png_(self) -> bytes:
        image = BytesIO()
        self.savefig(image, format="png", dpi=SCREEN_DPI)
        return image.getvalue()


def draw(chart: Chart, file: Path) -> None:
    """Draw a chart to a file; its suffix sets the format."""
    figure(chart).savefig(file, dpi=FILE_DPI)


def figure(chart: Chart) -> Figure:
    """Return a chart as a figure."""
    mpl.rcParams["svg.hashsalt"] = "autotuner"  # the same picture gives the same file
    heights = [panel.height for panel in chart.panels]
    drawing = Drawing(figsize=(10.0, 1.5 + sum(heights) / INCH), layout="constrained")
    rows = drawing.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    for axes, panel in zip(rows, chart.panels, strict=True):
        _draw_panel(axes, panel, chart)
    rows[-1].set_xlabel(chart.axis)
    rows[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, frameon=False)
    return drawing


def _draw_panel(axes: Axes, panel: Panel, chart: Chart) -> None:
    for curve in panel.curves:
        colour = COLOURS[curve.colour]
        if curve.kind == "dots":
            axes.plot(chart.t, curve.values, ".", ms=2.5, color=colour, alpha=0.55, label=curve.label)
        else:
            style = "steps-post" if curve.kind == "step" else "default"
            axes.plot(chart.t, curve.values, drawstyle=style, color=colour, lw=1.1, label=curve.label)
    for level, label in panel.lines:
        axes.axhline(level, color=LIMIT_COLOUR, ls="--", lw=0.8, label=label)
    for span in chart.spans:
        axes.axvspan(span.start_s, span.end_s, color=UNFITTED_COLOUR, alpha=0.12, lw=0, label=span.name)
    axes.set_ylabel(panel.title)
