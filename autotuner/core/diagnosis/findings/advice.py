"""Advice on an effect, and on experiments that would show more.

A reaction runs away where its heat grows as fast with the PV as the loss does: it takes up the share `q` of that growth
at rest, and `e` times as much for each `1/c` of the PV, so that is

    ln(1/q)/c

above the PV at rest (Semenov's limit, by the curve that the record shows), and at the upper ends of the intervals of
both perhaps earlier.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.core.effect_plugins import installed_effects

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

REMEDIES: dict[str, str] = {
    "backlash": "dead-band {width:.3g} of output: have the linkage or positioner serviced; until then expect a slow "
    "cycle under integral action, and keep the integral gain low",
    "stiction": "the valve sticks within {band:.3g} of output: service packing and positioner; no gains cure the cycle "
    "that it makes under integral action",
    "saturation": "the actuator ends before the output does: set the output limits there, so that the controller does "
    "not wind up",
    "rate_limit": "the actuator moves by {rate_per_s:.3g} of output a second at most: limit the output's slew too, "
    "and do not ask for a faster loop",
    "output_quantisation": "the actuator knows steps of {step:.3g} of output only: expect a small cycle; a finer "
    "converter or positioner ends it",
    "actuator_hold": "the actuator takes over its command every {period_s:.3g} s only: half of that is dead time; "
    "shorten the update, or tune with it",
    "time_proportioning": "the output is switched on and off with a period of {period_s:.3g} s: half of that is dead "
    "time, and the PV has its ripple; shorten the period, or tune with it",
    "static_nonlinearity": "the gain depends on the position of the actuator: linearise the valve or heater "
    "characteristic, or schedule the gains by the output",
    "direction_gain": "the gain above the rest is {ratio:.3g} times the one below: use two sets of gains (heating and "
    "cooling), or those for the larger gain",
    "direction_dynamics": "it rises {rise_over_fall:.3g} times as fast as it falls: tune for the faster direction",
    "flow_delay": "the dead time depends on the flow: up to {longest_over_first:.3g} times that at the first flow; "
    "tune for the longest one, or schedule the gains by the flow",
    "dead_time_jump": "the dead time became {later_over_first:.3g} times that of before at {at_s:.4g} s of the record: "
    "find what changed the flow or the line; tune for the longer one",
    "extra_lag": "a further lag of {time_constant_s:.3g} s is in the loop: check sensor well and filter; use the "
    "gains of the extended model",
    "inverse_response": "the PV first answers the wrong way (zero at {Z:.3g} s): use the gains of the extended model "
    "where it has any, without much derivative action",
    "integrating": "it does not settle: use gains for an integrating process",
    "slow_mode": "a slow second mode ({time_constant_s:.3g} s) carries a part of the answer: expect a long creep after "
    "each step; integral action takes care of it",
    "recycle": "{share:.0%} of what leaves the process is back at its input after {return_time_s:.3g} s: expect a long "
    "approach in steps; a shorter or smaller return, or feed-forward from it, makes the loop quicker",
    "nonlinear_loss": "losses do not grow in proportion to the PV: schedule the gains by the PV when it moves far",
    "nonlinear_stiffness": "the spring grows harder or softer with the PV: the loop rings at another frequency far "
    "from rest; schedule the gains by the PV, or stay near the point of this test",
    "process_friction": "dry friction of {coulomb:.3g} of output on the process itself: expect stick-slip or a "
    "standing error at low speed; compensate it by {coulomb:.3g} in the direction of motion, with little integral gain",
    "state_saturation": "a state reaches its limit: keep the PV below, and let the integrator stop there",
    "gain_drift": "the process gain changes with time: check for fouling or a changing supply; tune again after it",
    "load_step": "a load of {size:.3g} of output came at {at_s:.4g} s of the record: find its cause; the gains of the "
    "extended model are free of it",
    "drift": "the PV drifted during the record: the gains of the extended model are free of it",
    "periodic_disturbance": "a disturbance with a period of {period_s:.4g} s acts on the PV: find the neighbour that "
    "swings; the loop removes it only if it is much faster",
    "ambient": "the surroundings act on the PV: use the measured value for feed-forward",
    "measured_disturbance": "a measured disturbance acts on the PV: use it for feed-forward",
    "sensor_quantisation": "the sensor knows steps of {step:.3g} only: filter before derivative action, or take "
    "a finer range of the converter",
    "sensor_hysteresis": "the reading stands still for {width:.3g} after each reversal of the PV: free the float or "
    "the linkage of the sensor; no gains cure the cycle that integral action makes of it",
    "bias_step": "the reading jumped by {size:.3g} at {at_s:.4g} s of the record: check the sensor and its connections",
    "outliers": "single readings are far off: check the wiring, shielding and the converter; filter by a median",
    "timing_jitter": "samples are taken up to {spread_s:.3g} s beside their time stamps: stamp them when read",
    "not_settled": "the process was not at rest at the beginning: wait longer before the next test",
}
REACTION = ("heat_share", "growth_per_pv")
"""Sizes of a loss with the heat of a reaction."""
RUNS_AWAY = (
    "a reaction gives back {share:.0%} of what the loss grows with the PV, and more with each degree. From {above:.3g} "
    "above the PV at rest, perhaps from {earliest:.3g}, it heats faster than the loss cools, and no constant output "
    "holds it: set an interlock well below, and schedule the gains by the PV"
)
"""Advice on such a loss."""
TELLS_APART: dict[frozenset[str], str] = {
    frozenset({"backlash", "stiction"}): "a slow ramp of the output: play gives a smooth PV after it, sticking gives "
    "steps",
    frozenset({"load_step", "bias_step"}): "a second record: a sensor's jump stays without any answer of the process",
    frozenset({"drift", "load_step"}): "a longer record at rest",
    frozenset({"saturation", "static_nonlinearity"}): "a staircase of small steps up to the end of the range",
    frozenset({"direction_gain", "static_nonlinearity"}): "a staircase with more levels on both sides of the rest",
    frozenset({"direction_gain", "saturation"}): "a staircase with more levels on both sides of the rest",
    frozenset({"nonlinear_loss", "static_nonlinearity"}): "the same steps of the output about another PV",
    frozenset({"flow_delay", "actuator_hold"}): "the same steps again: updates come at other times then, and the flow "
    "is the same",
    frozenset({"flow_delay", "direction_dynamics"}): "the same step from a low level and from a high one",
    frozenset({"rate_limit", "extra_lag"}): "steps of two sizes: a limited rate takes twice as long for the double",
}


def remedy(name: str, sizes: Mapping[str, float], interval95: Mapping[str, tuple[float, float]] | None = None) -> str:
    """Return the advice on an effect, with its sizes, and where it depends on them also with their intervals."""
    share, growth_per_pv = (sizes.get(size, 0.0) for size in REACTION)
    if share > 0.0 and growth_per_pv > 0.0:
        most = [(interval95 or {}).get(size, (0.0, sizes[size]))[1] for size in REACTION]
        return RUNS_AWAY.format(share=share, above=_runs_away(share, growth_per_pv), earliest=_runs_away(*most))
    plugin = installed_effects().get(name)
    words = REMEDIES.get(name, "") if plugin is None else plugin.advice
    try:
        return words.format(**sizes)
    except KeyError:
        return words.split(":")[-1].strip()


def _runs_away(share: float, growth_per_pv: float) -> float:
    """Return how far above the PV at rest a reaction runs away, PV; 0 where that is not known."""
    return math.log(1.0 / share) / growth_per_pv if share < 1.0 and growth_per_pv < math.inf else 0.0


def separating(name: str, alike: Sequence[str]) -> list[str]:
    """Return notes on the experiments that would separate an effect from those that explain the record as well."""
    default = "a record with a staircase of small moves up and down, longer and with less noise"
    return [
        f"{name} and {other} explain this record equally well; to separate them: "
        f"{TELLS_APART.get(frozenset({name, other}), default)}"
        for other in alike
    ]
