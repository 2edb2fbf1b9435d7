"""Units of the reported sizes of effects, in terms of `output` and `PV`.

Invariants: a size whose name ends with its unit in seconds needs no row; a ratio has the empty unit.
"""

from __future__ import annotations

OUTPUT, PV = "output", "PV"
UNITS: dict[str, str] = {
    **dict.fromkeys(
        (
            "band",
            "jump",
            "change_over_swing",
            "no_flow_at",
            "about_output",
            "coulomb",
            "constant",
            "low",
            "high",
            "range",
        ),
        OUTPUT,
    ),
    **dict.fromkeys(("amplitude", "typical_size", "limit_above_rest", "pv_in_all", "pv_off_at_start"), PV),
    **dict.fromkeys(("first_limit_above_start", "second_limit_above_start"), PV),
    "Z": "s",
    **dict.fromkeys(("rate_per_s", "falling_rate_per_s"), "output/s"),
    "pv_per_s": "PV/s",
    "gain_per_s": "PV/(output s)",
    **dict.fromkeys(("curvature", "flow_per_output"), "1/output"),
    "curvature_per_output": "1/output",
    "third": "1/output²",
    "square_per_pv": "1/PV",
    **dict.fromkeys(("loss_per_pv", "growth_per_pv"), "1/PV"),
    "cubic_per_pv2": "1/PV²",
    "relative_change_per_h": "1/h",
    "gain": "PV per unit of its column",
}
"""Units by the name of the size."""
BY_PLACE = {"size", "step", "width"}
"""Sizes of effects on the reading or before the process: in PV units in the sensor, in output units elsewhere."""


def unit_of(place: str, size: str) -> str:
    """Return the unit of a size of an effect at a place; empty for a ratio."""
    if size in BY_PLACE:
        return PV if place == "sensor" else OUTPUT
    seconds = size.endswith("_s") and not size.endswith("_per_s")
    return UNITS.get(size, "s" if seconds else "")
