"""Measured against model, as a picture file."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING

import matplotlib as mpl
from matplotlib.figure import Figure

from autotuner.core.identification import simulate_fit

if TYPE_CHECKING:
    from pathlib import Path

    from autotuner.core.identification import Identification
    from autotuner.core.recording import Recording


SCREEN_DPI = 80
"""Resolution in a notebook."""


def draw(recording: Recording, identification: Identification, file: Path, pv_unit: str, output_unit: str) -> None:
    """Draw PV measured and simulated, the output, and the residual to a file with an ending of `PICTURES`."""
    figure_of(recording, identification, pv_unit, output_unit).savefig(file, dpi=120)


class Drawing(Figure):
    """A figure that a notebook shows without being told to draw inline."""

    def _repr_png_(self) -> bytes:
        image = BytesIO()
        self.savefig(image, format="png", dpi=SCREEN_DPI)
        return image.getvalue()


def figure_of(recording: Recording, identification: Identification, pv_unit: str, output_unit: str) -> Figure:
    """Return the whole record: PV measured and simulated, output, residual; the part that was not fitted is shaded."""
    mpl.rcParams["svg.hashsalt"] = "autotuner"
    fitted = identification.recording or recording
    until_s = float(fitted.t[-1])
    recording = fitted if identification.disturbances else recording
    figure = Drawing(figsize=(10.0, 7.0), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(3, 1, 1))
    top.plot(recording.t, recording.pv, ".", ms=2.5, color="0.6", label="measured")
    if identification.model is not None:
        simulated = simulate_fit(identification.model, recording, until_s)
        top.plot(recording.t, simulated, color="C0", lw=1.2, label=f"model ({identification.structure})")
        bottom.plot(recording.t, recording.pv - simulated, color="C3", lw=0.8)
    middle.step(recording.acts_s, recording.output, where="post", color="C1", lw=1.0)
    if until_s < recording.t[-1]:
        for axes in (top, middle, bottom):
            axes.axvspan(until_s, recording.t[-1], color="0.5", alpha=0.12, lw=0, label="not fitted")
    top.set_ylabel(f"PV {pv_unit}".strip())
    middle.set_ylabel(f"output {output_unit}".strip())
    bottom.set_ylabel(f"residual {pv_unit}".strip())
    bottom.set_xlabel("t, s")
    top.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False)
    return figure
