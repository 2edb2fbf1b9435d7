"""Dead time of a pipe whose flow changes: with the output, or once, whatever the output does.

    integral of q over (t - L, t) = V,      q = q0 (1 + a u) > 0,      process input  u(t - L(t))

`L` lag, `u` position as deviation from its start, `a` relative change of the flow with it. With `V/q0` known, the dead
time at the first flow, a position that is taken at `t_i` leaves the pipe at

    t_i' = Q^-1(Q(t_i) + V/q0),     Q(t) = integral of q/q0

`Q` is straight between two moves, so that this is exact. Behind the curve of a valve, q = q0 (1 + b a u)^(1/b): a power
of the output, in the limit of small `b` that of equal percentages, q0 e^(a u). A share of the dead time may lie
elsewhere, as in an analyser, and stay as it is. Where the flow changes from `q0` to `q0/r` at a time `t*`, the
dead time becomes `r` times as long: `Q(t) = min(t, t*) + max(t - t*, 0)/r`. Where it does so evenly within a while
`W`, the flow falls to `q0/(1 + k s)`, with `s = t - t*` and `k = (r - 1)/W`:  `Q = t* + ln(1 + k s)/k`  up to `s = W`,
and straight from there.
(Zenger and Ylinen, IFAC World Congress 2002; the transport delay of plug flow.)
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

LEAST_FLOW = 0.05
"""Smallest flow in a record over the first one: below, the content of the pipe hardly moves."""
MOST_CHANGE = 6.0
"""Largest change of the flow over the swing of the output, in first flows."""
LARGEST_RATIO = 5.0
"""Largest ratio of two dead times, either way: beyond, hardly a response of the process is left in a record."""
JUMPS, MOMENTS = (0.4, 0.65, 1.5, 2.3), 12
"""Ratios of the later dead time to the first to begin from, and the number of moments."""
WITHIN_A_WHILE, LONGEST, CHANGES = "within a while", 0.3, (0.03, 0.1)
"""What a change that lasts is called, its longest time over that of the record, and those to begin from."""
SAME_FLOW = 1e-9
"""Relative change of the flow that is the rounding of a double."""
FEWEST_MOVES = 2
"""Moves of the output on either side of a jump: one move alone may be late for any other reason."""
STARTS = (-1.2, -0.5, 0.3, 0.7, 1.2, 2.0)
"""Changes of the flow over the swing to begin from."""
BEHIND_A_CURVE = "behind a curve"
"""What a flow by a power of the output is called, in a pipe that has a part of the dead time."""
BENDS, LEAST_SHARE = (0.1, 2.0), 0.2
"""One over the power: 10, all but the exponential of an equal-percentage valve, to the root of an orifice's level; and
the least share of the dead time in the pipe: of a smaller one, a record shows no curve."""
STRAIGHT, CURVED = (1.0, 1.0), (0.6, 0.7)
"""Bend, and share of the dead time, of a flow in proportion in a pipe that has all of it; and those to begin from."""


def flow_delay(dataset: Dataset) -> Effect:
    """Return the effect; the flow rises with the output, or falls as behind a bypass valve.

    In its place, a flow behind the curve of a valve is tried, in a pipe that has a part of the dead time.
    """
    swing, levels = dataset.swing, dataset.data.held.levels / dataset.swing
    highest, lowest = max(float(levels.max()), 0.0), min(float(levels.min()), 0.0)
    most = min((1.0 - LEAST_FLOW) / max(-lowest, 1e-9), MOST_CHANGE)
    least = max(-(1.0 - LEAST_FLOW) / max(highest, 1e-9), -MOST_CHANGE)

    def numbers(p: Sequence[float]) -> Sequence[float]:
        return p if len(p) > 1 else (*p, *STRAIGHT)

    def transport(held: HeldInput, p: Sequence[float], delay_s: float, _: Dataset) -> HeldInput:
        change, bend, share = numbers(p)
        return carried(held, change / swing, share * delay_s, bend)

    def sizes(p: Sequence[float], _c: Sequence[float], _g: float) -> Mapping[str, float]:
        change, bend, share = numbers(p)
        slowest = float(flow_at(change * np.array([highest, lowest]), bend).min())
        found = {"flow_per_output": change / swing, "longest_over_first": 1.0 + share * (1.0 / slowest - 1.0)}
        return {**found, "power": 1.0 / bend, "share_of_dead_time": share} if len(p) > 1 else found

    straight = Effect(
        "flow_delay",
        Place.PROCESS,
        (Searched("change", least, most, 1e-4),),
        [(change,) for change in STARTS if least < change < most],
        sizes,
        transport=transport,
        order=3,
        group="timing",
    )
    curved = replace(
        straight,
        form=BEHIND_A_CURVE,
        searched=(*straight.searched, Searched("bend", *BENDS, 1e-4), Searched("share", LEAST_SHARE, 1.0, 1e-4)),
        starts=[(*start, *CURVED) for start in straight.starts],
        price=2.0,
    )
    return replace(straight, other_forms=(curved,))


def dead_time_jump(dataset: Dataset, fewest: int = FEWEST_MOVES) -> Effect:
    """Return a dead time that jumps at a time: another flow of what carries it, another line to the sensor.

    It means that where `fewest` moves at least lie on either side.
    """
    span, share = dataset.span_s, dataset.fitted_until_s / dataset.span_s

    def transport(held: HeldInput, p: Sequence[float], delay_s: float, _: Dataset) -> HeldInput:
        return carried_since(held, p[0] * span, math.exp(p[1]), delay_s, *(lasts * span for lasts in p[2:]))

    jump = Effect(
        "dead_time_jump",
        Place.PROCESS,
        (
            Searched("moment", 0.01, 0.99, 1e-4, profiled=True),
            Searched("log_ratio", -math.log(LARGEST_RATIO), math.log(LARGEST_RATIO), 1e-4, profiled=True),
        ),
        [(share * m, math.log(r)) for m in np.linspace(0.05, 0.9, MOMENTS).tolist() for r in JUMPS],
        lambda p, _c, _g: {"at_s": p[0] * span, "later_over_first": math.exp(p[1])},
        transport=transport,
        order=3,
        price=math.log(MOMENTS),
        group="timing",
        means=lambda p, _c, _g, _shape: _moves_apart(dataset, p[0] * span) >= fewest,
    )
    slower = replace(
        jump,
        form=WITHIN_A_WHILE,
        searched=(*jump.searched, Searched("lasts", 0.0, LONGEST, 1e-4)),
        sizes=lambda p, c, g: {**jump.sizes(p[:2], c, g), "lasts_s": p[2] * span},
        starts=[(*start, lasts) for start in jump.starts for lasts in CHANGES],
    )
    return replace(jump, other_forms=(slower,))


def _moves_apart(dataset: Dataset, at_s: float) -> int:
    """Return the number of moves before a time or after it on the fitted part, whichever is smaller."""
    moves = dataset.data.held.times[1:]
    before = int(np.count_nonzero(moves < at_s))
    return min(before, int(np.count_nonzero(moves < dataset.fitted_until_s)) - before)


def carried_since(held: HeldInput, at_s: float, ratio: float, delay_s: float, lasts_s: float = 0.0) -> HeldInput:
    """Return a position as it leaves the pipe, the first dead time left out, where the flow changes at a time.

    Parameters
    ----------
    held : HeldInput
        The position.
    at_s : float
        Time of the change, s.
    ratio : float
        Dead time after it, over that before.
    delay_s : float
        Dead time before it, s.
    lasts_s : float
        Time within which the dead time of the momentary flow changes evenly, s.
    """
    k = (ratio - 1.0) / lasts_s if lasts_s and abs(ratio - 1.0) > SAME_FLOW else 0.0
    whole = math.log(ratio) / k if k else lasts_s  # what passes within that time
    since = np.clip(held.times - at_s, 0.0, lasts_s)
    later = np.maximum(held.times - at_s - lasts_s, 0.0)
    passed = np.minimum(held.times, at_s) + (np.log1p(k * since) / k if k else since) + later / ratio + delay_s
    within = np.clip(passed - at_s, 0.0, whole)
    took = np.expm1(k * within) / k if k else within
    times = np.minimum(passed, at_s) + took + np.maximum(passed - at_s - whole, 0.0) * ratio - delay_s
    return _arriving(held, times)


def flow_at(change: FloatArray, bend: float) -> FloatArray:
    """Return the flow over the first one, `(1 + b x)^(1/b)`, of relative changes `x` at the first slope."""
    result: FloatArray = np.maximum(np.maximum(1.0 + bend * change, 0.0) ** (1.0 / bend), LEAST_FLOW)
    return result


def carried(held: HeldInput, flow_per_output: float, delay_s: float, bend: float = 1.0) -> HeldInput:
    """Return a position as it leaves the pipe, the dead time at the first flow left out.

    Parameters
    ----------
    held : HeldInput
        The position, output units as deviation from its start.
    flow_per_output : float
        Relative change of the flow, 1/output.
    delay_s : float
        Dead time in the pipe at the first flow, s.
    bend : float
        One over the power of the output that the flow follows.
    """
    flow = flow_at(flow_per_output * held.levels, bend)
    passed = np.concatenate(([0.0], np.cumsum(flow[:-1] * np.diff(held.times))))
    leaves = passed + delay_s
    k = np.searchsorted(passed, leaves, side="right") - 1
    times = held.times[k] + (leaves - passed[k]) / flow[k] - delay_s
    return _arriving(held, times)


def _arriving(held: HeldInput, times: FloatArray) -> HeldInput:
    """Return a position that arrives at other times; an early arrival may precede the start."""
    times[0] = min(float(held.times[0]), float(times[1:].min(initial=np.inf)))
    return HeldInput(times, held.levels)
