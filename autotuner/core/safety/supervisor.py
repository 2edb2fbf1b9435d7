"""The safety supervisor: consulted before every write, independent of the experiment.

    u_k in [lowest, highest],   |u_k - u_{k-1}| <= slew (t_k - t_{k-1})

and a row of watches over every sample: ownership, lateness, missing PV, position and prediction of the
PV (`pv_prediction`), sensor (`sensor_watch`), and used budgets (`watches`).

Invariants:

1. A limit is never exceeded "for a moment"; `permit` is the only way to an output.
2. A trip is a verdict that names the limit, the value and the time. It does not act: the controller restores.
3. Every watch sees every sample, so that none is blind after another one; the first verdict of the row counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Literal

from autotuner.core.safety.ownership_watch import MODE_CHANGED, MODE_REFUSED, ModeWatch, SetPointWatch
from autotuner.core.safety.pv_prediction import PvWatch
from autotuner.core.safety.sensor_watch import FrozenWatch, JumpWatch
from autotuner.core.safety.watches import (
    BlindnessWatch,
    LatenessWatch,
    SampleContext,
    SpendingWatch,
    TimeWatch,
    process_stalled,
)
from autotuner.core.verdict import aborted
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.experiment.settings import Limits
    from autotuner.core.recording import Sample
    from autotuner.core.safety.watches import Watch
    from autotuner.core.verdict import Verdict
    from autotuner.errors import AutotunerError

DRIVEN_BY_OTHERS = frozenset({MODE_CHANGED, MODE_REFUSED})
"""Codes of the trips after which nothing is restored: the device's own controller, or a person, drives the loop."""


@dataclass(frozen=True, slots=True)
class SafetySettings:
    """Settings of the watches besides the limits.

    Attributes
    ----------
    pv_timeout_s : float
        Longest time without a usable PV, s.
    max_lateness_s : float
        Largest lateness of a sample, s.
    frozen_samples : int
        Fewest samples without any change of a PV that was noisy at rest, before it counts as frozen.
    travel : float
        Largest sum of all changes of the output, output units.
    energy : float
        Largest |integral of (output - output at the start) dt|, output units x s: the energy supplied to the process,
        or withheld, relative to its rest.
    phase_limit_s, time_limit_s : float
        Longest time in one phase and in all, s; the second backs the experiment's own limit.
    device_gone : str
        ``end``: a device that has closed the link and takes no new one ends the experiment at once; ``wait``: only when
        there was no PV for `pv_timeout_s`.
    """

    pv_timeout_s: float
    max_lateness_s: float
    frozen_samples: int = 20
    travel: float = math.inf
    energy: float = math.inf
    phase_limit_s: float = math.inf
    time_limit_s: float = math.inf
    device_gone: Literal["end", "wait"] = "end"

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, str) and not value > 0:
                raise InputError(
                    "must be positive", field=f"safety.{field.name}", value=value, remedy="Give a positive number."
                )


class Supervisor:
    """Watches one tuning.

    Parameters
    ----------
    limits : Limits
        Output, slew and PV limits.
    settings : SafetySettings
        Settings of the watches.

    Attributes
    ----------
    pv_timeout_s : float
        Longest time without a usable PV, s.
    """

    def __init__(self, limits: Limits, settings: SafetySettings) -> None:
        self.pv_timeout_s = settings.pv_timeout_s
        self._ends_when_gone = settings.device_gone == "end"
        self._limits = limits
        self._blindness = BlindnessWatch(settings.pv_timeout_s)
        mode, set_point = ModeWatch(settings.pv_timeout_s), SetPointWatch()
        self._doubts = (mode.doubt, set_point.doubt)
        self._of_others: tuple[Watch, ...] = (mode, set_point)
        self._always: tuple[Watch, ...] = (
            LatenessWatch(settings.max_lateness_s),
            TimeWatch(settings.time_limit_s, settings.phase_limit_s),
            SpendingWatch(settings.travel, settings.energy),
        )
        self._of_the_pv: tuple[Watch, ...] = (
            PvWatch(limits.pv),
            FrozenWatch(settings.frozen_samples),
            JumpWatch(),
        )

    @property
    def doubt(self) -> str:
        """Indication of the last sample on mode or set point that the next one must confirm; empty without any.

        Such a sample is not to be used, and nothing to be written before the next reading.
        """
        return "; ".join(doubt.pending for doubt in self._doubts if doubt.pending)

    @property
    def damaged(self) -> list[str]:
        """Values of single readings that the next ones did not confirm."""
        return [text for doubt in self._doubts for text in doubt.damaged]

    def permit(self, output: float, held: float, dt_s: float) -> float:
        """Return the output nearest to the wanted one that limits and slew allow.

        Parameters
        ----------
        output : float
            Wanted output, output units; NaN holds the present one.
        held : float
            Present output, output units.
        dt_s : float
            Time since the last change, s.
        """
        wanted = held if math.isnan(output) else output
        travel = self._limits.output_slew_per_s * dt_s
        low, high = self._limits.output
        allowed = min(max(wanted, held - travel), held + travel) if math.isfinite(travel) else wanted
        return min(max(allowed, low), high)

    def check(
        self, sample: Sample, *, auto: float | None = None, phase: str = "", still_s: float | None = None
    ) -> Verdict | None:
        """Return a verdict when a limit is passed by this sample, or will be before the output can act.

        Parameters
        ----------
        sample : Sample
            What was read; its output is the one held until now.
        auto : float, optional
            The device's mode bit, None when it has none: once seen in manual it must stay there.
        phase : str
            The phase in which the sample was taken.
        still_s : float, optional
            Time since the sample before in which no reading was possible, s; by default its lateness.
        """
        usable = math.isfinite(sample.pv)
        context = SampleContext(sample, auto, phase)
        verdicts = [watch.check(context) for watch in self._of_others]
        still_s = sample.lateness_s if still_s is None else still_s
        verdicts.append(self.check_blindness(sample.t, usable=usable, still_s=still_s))
        verdicts += [watch.check(context) for watch in self._always]
        if usable:
            verdicts += [watch.check(context) for watch in self._of_the_pv]
        return next((verdict for verdict in verdicts if verdict is not None), None)

    def check_gone(self, t: float) -> Verdict | None:
        """Return a verdict when a device that has closed the link and takes no new one ends the experiment at once."""
        if not self._ends_when_gone:
            return None
        return aborted(
            "device_gone",
            f"the device closed the link at {t:.3f} s and takes no new one",
            'Check the device; for a device that restarts on its own, set safety.device_gone = "wait".',
        )

    def check_blindness(self, t: float, *, usable: bool, still_s: float = 0.0) -> Verdict | None:
        """Return a verdict after too long a time without a usable PV, also when this one is usable again.

        `still_s` is the time since the reading before in which none was possible.
        """
        return self._blindness.check_usable(t, usable=usable, still_s=still_s)

    def check_still(self, t: float, still_s: float) -> Verdict | None:
        """Return a verdict when the program itself was stopped for too long; for a call that failed meanwhile."""
        return process_stalled(still_s, self.pv_timeout_s, t) if still_s > self.pv_timeout_s else None

    def check_failure(self, t: float, still_s: float, failure: AutotunerError) -> Verdict | None:
        """Return a verdict when readings have failed for too long, with why this one did where that is the reason."""
        return self._blindness.check_usable(t, usable=False, still_s=still_s, failure=failure)
