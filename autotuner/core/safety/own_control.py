"""Watches of a loop under its device's own controller: at rest, settling, verified.

The device moves its output: neither its way nor its energy are for the supervisor to judge. What remains is the time
without a PV, the limits of the PV, and whether the device is taken to manual.

Invariant: a single reading of a changed mode, or of a PV beyond its limits, is in doubt until the next one
confirms it (`Doubt`). Such a sample is not used.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.core.recording import Sample
from autotuner.core.safety.ownership_watch import MODE_CHANGED, Doubt
from autotuner.core.safety.supervisor import Supervisor
from autotuner.core.verdict import Verdict, aborted

if TYPE_CHECKING:
    from autotuner.core.experiment.settings import Limits
    from autotuner.core.safety.supervisor import SafetySettings
    from autotuner.errors import AutotunerError


class OwnControlWatch:
    """Watches one loop under its device's own controller.

    Parameters
    ----------
    limits : Limits
        Those of the PV count.
    settings : SafetySettings
        Settings of the other watches.

    Attributes
    ----------
    supervisor : Supervisor
        Judges the remaining conditions.
    doubt : str
        What the last sample indicates and the next one must confirm; such a sample is not to be used. Empty else.
    """

    def __init__(self, limits: Limits, settings: SafetySettings) -> None:
        self.supervisor = Supervisor(limits, settings)
        self.doubt = ""
        self._limits = limits
        self._mode, self._pv = Doubt(), Doubt()

    @property
    def damaged(self) -> list[str]:
        """Values of single readings that the next ones did not confirm."""
        return [*self._mode.damaged, *self._pv.damaged]

    def check(self, sample: Sample, *, auto: float | None, phase: str, still_s: float) -> Verdict | None:
        """Return a verdict when the loop may not be left to the device any longer, or is not the device's any more."""
        taken = None if auto is None or auto else _taken(sample.t)
        beyond = self._beyond(sample)
        is_taken, is_beyond = self._mode.settle(taken), self._pv.settle(beyond)
        pending = ((taken, is_taken), (beyond, is_beyond))
        self.doubt = "; ".join(found.message for found, certain in pending if found is not None and certain is None)
        if is_taken is not None:
            return is_taken
        if self.doubt:
            return self.supervisor.check_blindness(sample.t, usable=False, still_s=still_s)
        held = Sample(sample.t, sample.pv, self._limits.output[0], math.nan, sample.lateness_s)
        return self.supervisor.check(held, phase=phase, still_s=still_s)

    def check_failure(self, t: float, still_s: float, failure: AutotunerError) -> Verdict | None:
        """Return a verdict when readings have failed for too long."""
        return self.supervisor.check_failure(t, still_s, failure)

    def _beyond(self, sample: Sample) -> Verdict | None:
        low, high = self._limits.pv
        if not math.isfinite(sample.pv) or low <= sample.pv <= high:
            return None
        return aborted("pv_limit", f"the PV went to {sample.pv:.5g} at {sample.t:.3f} s", "Check the sensor.")


def _taken(t: float) -> Verdict:
    return aborted(
        MODE_CHANGED, f"the device went to manual at {t:.3f} s", "An operator or another program took the loop over."
    )
