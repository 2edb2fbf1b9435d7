"""Measured against model, as a picture file."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
from matplotlib.figure import Figure

from autotuner.core.identification import simulate_fit
from autotuner.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    from autotuner.core.identification import Identification
    from autotuner.core.recording import Recording

FORMATS = (".png", ".svg", ".pdf")


def draw(recording: Recording, identification: Identification, file: Path, pv_unit: str, output_unit: str) -> None:
    """Draw PV measured and simulated, the output, and the residual, one above the other.

    Raises
    ------
    InputError
        The file's ending is not one of `FORMATS`, or it cannot be written.
    """
    if file.suffix.lower() not in FORMATS:
        raise InputError("is no picture format", field="--picture", value=str(file), remedy=f"End it in {FORMATS}.")
    mpl.rcParams["svg.hashsalt"] = "autotuner"
    recording = identification.recording or recording
    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(3, 1, 1))
    top.plot(recording.t, recording.pv, ".", ms=2.5, color="0.6", label="measured")
    if identification.model is not None:
        simulated = simulate_fit(identification.model, recording)
        top.plot(recording.t, simulated, color="C0", lw=1.2, label=f"model ({identification.structure})")
        bottom.plot(recording.t, recording.pv - simulated, color="C3", lw=0.8)
    middle.step(recording.acts_s, recording.output, where="post", color="C1", lw=1.0)
    top.set_ylabel(f"PV {pv_unit}".strip())
    middle.set_ylabel(f"output {output_unit}".strip())
    bottom.set_ylabel("residual")
    bottom.set_xlabel("t s")
    top.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
    try:
        figure.savefig(file, dpi=120)
    except OSError as error:
        raise InputError(
            f"cannot be written: {error.strerror}", field="--picture", value=str(file), remedy="Choose another place."
        ) from error
