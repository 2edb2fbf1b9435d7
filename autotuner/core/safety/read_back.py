"""The output that the device really holds, from its read-back.

    held = read                       while |read - commanded| <= tolerance
    held = commanded, and a strike    otherwise; `STRIKES` in a row end the tuning, fewer were damaged readings

A register rounds: an output of 28.333 is held as 28.3. This small error is the same in every half period of
a relay, and the static gain results from such small differences: a resolution of 0.1 % changed K by
15 %. The record therefore holds the read-back values. A larger difference means that another program writes the output,
or that the device has switched it off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from autotuner.core.verdict import Verdict, aborted

STRIKES = 3
"""Samples in a row with a foreign output that end the tuning: a device may take a scan or two to follow."""


@dataclass(slots=True)
class ReadBack:
    """Follows the output of one device.

    Attributes
    ----------
    tolerance : float
        Largest difference that rounding explains, output units.
    damaged : list of str
        Foreign outputs that did not last, and were not on the way from one command to the next either.
    """

    tolerance: float
    damaged: list[str] = field(default_factory=list)
    _strikes: int = 0
    _commanded: tuple[float, float] = (math.nan, math.nan)
    _foreign: list[str] = field(default_factory=list)

    def held(self, commanded: float, read_back: float | None) -> float:
        """Return the output of the device; `read_back` is None or NaN when it is not reported."""
        if read_back is None or math.isnan(read_back):
            return commanded
        if commanded != self._commanded[1]:
            self._commanded = (self._commanded[1], commanded)
        foreign = abs(read_back - commanded) > self.tolerance
        self._strikes = self._strikes + 1 if foreign else 0
        if not foreign:
            self.damaged += self._foreign
            self._foreign.clear()
        elif not self._on_its_way(read_back):
            self._foreign.append(f"the output was read as {read_back:g} where {commanded:g} was commanded")
        return commanded if foreign else read_back

    def _on_its_way(self, read_back: float) -> bool:
        before, now = self._commanded
        return min(before, now) - self.tolerance <= read_back <= max(before, now) + self.tolerance

    def check(self, t: float, commanded: float, read_back: float | None) -> Verdict | None:
        """Return a verdict when the device has held a foreign output for too many samples."""
        if self._strikes < STRIKES:
            return None
        return aborted(
            "output_overridden",
            f"the device holds output {read_back:g}, not the {commanded:g} commanded, for {STRIKES} samples up to "
            f"{t:.3f} s",
            "Something else writes this output, or the device switched it off: find out, then try again.",
        )
