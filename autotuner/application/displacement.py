"""How far a tuning has moved the PV of a process that integrates: in manual nothing brings it back.

    displacement = K int (u - u_0) dt

over the record, `u_0` the output at the start, at which the loop rested: what is still on its way through the dead time
counts. `K` PV per output and second.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.process import Integrating

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Sample

AT_REST = 20
"""Samples at the start that tell the noise of the PV."""
SEEN = 3.0
"""Displacement, in standard deviations of the noise, from which it is reported."""


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
    moved = model.K * float((output[:-1] - output[0]) @ np.diff(t))
    if abs(moved) <= SEEN * float(np.std(pv[:AT_REST])):
        return None
    found = float(np.mean(pv[:AT_REST]))
    return (
        f"the process integrates, and the loop is in manual: the PV was left {moved:+.3g} from {found:.4g}, where it "
        "was found; bring it back by hand, or put the loop to automatic"
    )
