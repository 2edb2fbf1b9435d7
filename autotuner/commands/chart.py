"""A recording as characters: PV above, output below."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import plotext

if TYPE_CHECKING:
    from autotuner.core.recording import Recording

WIDEST = 110
"""Most columns of a chart: wider ones are no easier to read."""
PLAIN = str.maketrans("┌┐└┘├┤┬┴┼─│", "+++++++++-|")
"""Frames for an encoding that has none."""
POINTS = 2000
"""Most points drawn: a terminal shows two a column."""


def chart(recording: Recording, pv_unit: str, output_unit: str, width: int) -> str:
    """Return the picture as lines of text, coloured only for a terminal."""
    thin = slice(None, None, max(len(recording) // POINTS, 1))
    t = recording.t[thin].tolist()
    unicode = (sys.stdout.encoding or "").lower().startswith("utf")
    plotext.clear_figure()
    plotext.theme("clear")
    plotext.subplots(2, 1)
    curves = (("PV", pv_unit, recording.pv, 14), ("output", output_unit, recording.output, 8))
    for row, (name, unit, values, height) in enumerate(curves, start=1):
        plotext.subplot(row, 1)
        plotext.plot_size(min(width, WIDEST), height)
        plotext.title(f"{name} {unit}".strip())
        plotext.plot(t, values[thin].tolist(), marker="braille" if unicode else "*")
    plotext.xlabel("t s")
    text: str = plotext.build()
    if not unicode:
        text = text.translate(PLAIN)
    return text if sys.stdout.isatty() else plotext.uncolorize(text)
