"""Displacement of the PV of an integrating process by a tuning: in manual the PV does not return.

    displacement = PV at the end - PV at the start + K int (u - u_0) w(age) dt,   w = 1 up to D, then exp(-(age - D)/T)

`u_0` is the output at the start, at which the loop was at rest; `w` accounts for the response that is still to come. A
load during the test also moves the PV permanently, but is not part of this figure. `K` PV per output and second. A PV
that drifted when the loop was found is not where it was found in any case: then the displacement is a note.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.process import Integrating
from autotuner.core.notes import Note
from autotuner.core.signals.quiet import measure_quiet

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Sample

AT_REST, AT_END = 20, 3
"""Samples at the start from which the PV and its noise are estimated, and at the end."""
SEEN = 3.0
"""Displacement, in standard deviations of the noise, from which it is reported."""
WORTH_A_WORD = 0.05
"""The same, in the PV's range over the record: less is nothing that anybody would bring back by hand."""


def displacement_warning(samples: Sequence[Sample], model: ProcessModel | None, *, auto: bool) -> str | None:
    """Return by how much the PV was left from where it was found; None where something brings it back.

    Parameters
    ----------
    samples : sequence of Sample
        The record, from rest to the release.
    model : ProcessModel or None
        The identified process.
    auto : bool
        Whether the device's own controller drives the loop again.
    """
    if auto or not isinstance(model, Integrating) or len(samples) <= AT_REST:
        return None
    t, pv, output = (np.array([getattr(sample, name) for sample in samples]) for name in ("t", "pv", "output"))
    age = np.median(t[-AT_END:]) - t
    lagged = model.T * -np.expm1(-np.clip(age - model.D, 0.0, None) / model.T) if model.T > 0.0 else 0.0
    on_its_way = -np.diff(np.minimum(age, model.D) + lagged)
    found = float(np.mean(pv[:AT_REST]))
    displacement = float(np.median(pv[-AT_END:])) - found + model.K * float((output[:-1] - output[0]) @ on_its_way)
    if abs(displacement) <= max(SEEN * float(np.std(pv[:AT_REST])), WORTH_A_WORD * float(np.ptp(pv))):
        return None
    left = f"the process integrates, and the loop is in manual: the PV was left {displacement:+.3g} from {found:.4g}, "
    if _drifted(t, pv, output):
        return Note(f"{left}its initial value; it drifted when the loop was found, and goes on doing so in manual")
    return f"{left}its initial value; move it back by hand, or switch the loop to automatic"


def _drifted(t: FloatArray, pv: FloatArray, output: FloatArray) -> bool:
    """Return whether the PV drifted before the output first moved."""
    resting = int(np.argmax(output != output[0])) or output.size
    return resting >= AT_REST and measure_quiet(t[:resting], pv[:resting]).drifts
