"""Numbers of a report as text, each with its unit."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from autotuner.core.model.process import Integrating, NLags


def number(value: object, digits: int = 4) -> str:
    """Return a number with the given significant digits; an en dash for None."""
    return f"{value:.{digits}g}" if isinstance(value, int | float) and np.isfinite(value) else "–"


def with_unit(text: str, unit: str) -> str:
    """Return a number with its unit; units may be empty."""
    return f"{text} {unit}".rstrip()


def named(name: str, unit: str) -> str:
    """Return the name of a quantity with its unit, for a head or an axis."""
    return f"{name}, {unit}" if unit and unit != name else name


def ratio_unit(above: str, below: str) -> str:
    """Return the unit of a gain; empty where neither unit is known."""
    return f"{above or '1'}/{below or '1'}" if above or below else ""


@dataclass(frozen=True, slots=True)
class Units:
    """Units of a loop; the words "output" and "PV" where unknown.

    Attributes
    ----------
    pv, output : str
        Units of PV and output.
    """

    pv: str = "PV"
    output: str = "output"

    @classmethod
    def of(cls, pv: str, output: str) -> Units:
        """Return units that may be empty."""
        return cls(pv or cls().pv, output or cls().output)

    def named(self, unit: str) -> str:
        """Return a unit in terms of ``output`` and ``PV`` in those of the loop."""
        known = {"output": self.output, "PV": self.pv}
        return re.sub("|".join(known), lambda word: known[word.group()], unit)


def parameter_unit(name: str, structure: str, pv_unit: str, output_unit: str) -> str:
    """Return the unit of a parameter of a process model."""
    if name == "K":
        gain = ratio_unit(pv_unit, output_unit)
        return gain if structure != Integrating.structure else f"{gain or '1'}/s"
    if (name, structure) == ("n", NLags.structure):
        return ""
    return "s²" if name == "m" else "s"
