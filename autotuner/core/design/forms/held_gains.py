"""Gains as a device will hold them: in its form, rounded to its resolution, with new margins.

Invariants: margins are those of the held gains, after rounding and without the parts that the device lacks (a
measurement filter, a set-point weight), not of the requested ones; a loss of robustness is reported.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from autotuner.core.design.forms.pid_forms import DeviceGains, Spans, from_device, rounded, to_device
from autotuner.core.design.forms.presets import form_named
from autotuner.core.design.loop_margins import Margins, margins

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.design.gains import PidGains
    from autotuner.core.model.process import ProcessModel

NOTICEABLE = 0.02
"""Share by which the device may raise `Ms` before it is reported."""


@dataclass(frozen=True, slots=True)
class HeldGains:
    """Gains as held by a device.

    Attributes
    ----------
    form : str
        Name of the form.
    device : DeviceGains
        The numbers to write.
    labelled : dict of str to float
        The same under the device's own names.
    gains : PidGains
        The controller that they make.
    margins : Margins or None
        Its robustness on the model; None without a model.
    warnings : tuple of str
        What the device's rounding, and its lack of a filter, did to the robustness.
    """

    form: str
    device: DeviceGains
    labelled: dict[str, float]
    gains: PidGains
    margins: Margins | None
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "form": self.form,
            "values": self.labelled,
            **self.device.action.to_dict(),
            "gains": self.gains.to_dict(),
            "margins": self.margins.to_dict() if self.margins else None,
            "warnings": list(self.warnings),
        }


def held_by_device(
    gains: PidGains,
    form: str,
    *,
    spans: Spans | None = None,
    resolution: Mapping[str, float] | None = None,
    model: ProcessModel | None = None,
    fixed_b: float | None = None,
    fixed_N: float = math.inf,
) -> HeldGains:
    """Return the gains as a device holds them.

    Parameters
    ----------
    gains : PidGains
        The controller wanted.
    form : str
        Name of the device's form, one of `autotuner.core.design.FORMS`.
    spans : Spans, optional
        Full spans of PV and output, for devices that normalise.
    resolution : mapping of str to float, optional
        Smallest steps of ``gain``, ``integral``, ``derivative`` in the device.
    model : ProcessModel, optional
        The process on which the rounded gains are judged.
    fixed_b : float, optional
        Weight of the set point in a device that takes the three numbers only: its controller has no filter of the
        measurement. Without it both are taken as wanted.
    fixed_N : float
        Filter of the derivative in such a device; infinite for none.

    Raises
    ------
    InputError
        Unknown form, a span that is missing, gains that the form or its steps cannot hold.
    """
    row = form_named(form)
    supported = gains if fixed_b is None else replace(gains, Tf=0.0, b=fixed_b, N=fixed_N)
    device = rounded(to_device(supported, row, spans), resolution or {})
    held = replace(from_device(device, row, spans), N=supported.N)
    after = None if model is None else margins(model, held)
    before = None if model is None else margins(model, gains)
    return HeldGains(form, device, device.labelled(row), held, after, _changes(before, after))


def _changes(before: Margins | None, after: Margins | None) -> tuple[str, ...]:
    if before is None or after is None or before.Ms is None:
        return ()
    if after.Ms is None:
        return ("as the device holds them, rounded and with its own filter, the loop is unstable: choose calmer gains",)
    if after.Ms > before.Ms * (1.0 + NOTICEABLE):
        return (f"as the device holds them, the gains have Ms {after.Ms:.2f} instead of {before.Ms:.2f}",)
    return ()
