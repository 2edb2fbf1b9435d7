"""Friction and play of the actuator.

    e = command - x;   |e| > S:  x <- command - sign(e) F,   else x stays

`S` half the dead-band and stick-band, `F` the remaining part of it after a slip (He, Wang, Pottmann, Qin, Ind. Eng.
Chem. Res. 46, 2007). `F = S` is play (backlash) of width `2 S`; `F = 0` the valve that jumps to its command (Stenman,
Gustafsson, Forsman 2003); the jump is `S - F`.

Where the command rests between its moves the stem stops each time, and the accumulated command since counts (Kano,
Maruta, Kugemoto, Shimizu, DYCOPS 2004): the stem slips after `J` in the same direction and after `S` in the other one,
to `(S - J)/2` short of the command.

In a loop that cycles because of its valve, the controller reverses its output as soon as the valve slips, and no two
slips are equal. There the reversals of the output determine the slips better than any band:

    x = u_k - sign_k F + f (u - u_k)   from the k-th reversal on;   u_k output there, sign_k its previous direction

(`f` response of the position to small moves; after Choudhury, Shah, Thornhill, Diagnosis of Process Nonlinearities and
Valve Stiction, 2008, with the same test: the PV is constant while the output moves on, then jumps at its reversal.)

`x` position, output units, as deviation from its start.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched
from autotuner.core.diagnosis.record.waiting import waiting_of
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

SLIPS = {"stiction", "backlash"}
"""Names of the effects of this file."""
SMALLEST, SMALLEST_IN_LOOP, LARGEST = 0.004, 0.05, 0.9
"""Bounds of the bands, in swings of the output: a loop cycles over about its valve's band, and moves of its set point
are rarely more than twenty times that."""
TURNS = (0.15, 0.25, 0.4)
"""Return of the output that counts as a reversal, in swings."""
PLATEAUS = (0.0, 0.03, 0.1)
"""Distance from its extreme within which the output still rests there, in swings."""
PLAYS = (0.02, 0.05, 0.1, 0.18, 0.3, 0.5)
BANDS = (0.02, 0.04, 0.07, 0.1, 0.14, 0.19, 0.25, 0.33, 0.42, 0.55)
ALL = 1.0
"""Largest band where the valve is seen to stick: in a slow loop it slips once in a record."""
LEFT, LITTLE = (0.0, 0.5), 0.1
"""Shares of a band that are left after a slip, to start from; the last one with a band as wide as a move of the output,
which then slips in the direction of the move before, and sticks in the other one."""
LARGEST_LEFT = 0.9
"""Most of a band that may be left."""
TURNING = "turning"
"""Form of stiction that slips where the output turns."""
MOST_CHANGES, MOST_MOVES, MOST_BANDS = 400, 40, 14
"""Changes and distinct moves of the output up to which bands are tried between them, and how many."""


def friction_effects(dataset: Dataset) -> tuple[Effect, ...]:
    """Return play and sticking, from the swing and the moves of the output."""
    swing = dataset.swing
    least = SMALLEST_IN_LOOP if dataset.in_loop else SMALLEST
    bands = [*_bands(dataset), *(travel / swing for travel in waiting_of(dataset).travels)]
    starts = [*product(bands, LEFT), *((move, LITTLE) for move in _some(_moves(dataset)))]
    return (
        play(dataset, least, PLAYS),
        _play_with(dataset, least, "seated", Searched("seat", -0.5, 0.5, 1e-3), 0.4),
        sticking(dataset, least, starts),
        _play_with(dataset, least, "uneven", Searched("tilt", -1.5, 1.5, 1e-3), 0.5),
        *((_slipping(dataset, least),) if dataset.tuned else ()),
        *((_turning(dataset),) if dataset.in_loop or waiting_of(dataset).sticks else ()),
    )


def play(dataset: Dataset, least: float = SMALLEST, widths: Sequence[float] = ()) -> Effect:
    """Return plain play."""
    swing = dataset.swing
    return Effect(
        "backlash",
        Place.ACTUATOR,
        (Searched("width", least, LARGEST, 1e-4),),
        [(width,) for width in widths],
        lambda p, _c, _g: {"width": p[0] * swing},
        position=lambda held, p, _: backlash(held, p[0] * swing),
        order=3,
        group="friction",
    )


def _play_with(dataset: Dataset, least: float, form: str, further: Searched, start: float) -> Effect:
    """Return play with one more number: where it starts, or how its width changes with the position."""
    plain, swing = play(dataset, least), dataset.swing

    def sizes(p: Sequence[float], _c: Sequence[float], _g: float) -> Mapping[str, float]:
        return {"width": p[0] * swing, **({"change_over_swing": p[0] * p[1] * swing} if form == "uneven" else {})}

    def position(held: HeldInput, p: Sequence[float], _: Dataset) -> HeldInput:
        return backlash(held, p[0] * swing, **{further.name: p[1] / swing if form == "uneven" else p[1]})

    starts = [(width, way * start) for width in PLAYS for way in (-1.0, 1.0)]
    searched = (*plain.searched, further)
    return replace(plain, form=form, searched=searched, starts=starts, sizes=sizes, position=position, price=2.0)


def sticking(dataset: Dataset, least: float = SMALLEST, starts: Sequence[tuple[float, float]] = ()) -> Effect:
    """Return sticking of two bands."""
    swing = dataset.swing
    largest = ALL if waiting_of(dataset).sticks else LARGEST
    return Effect(
        "stiction",
        Place.ACTUATOR,
        (Searched("band", least, largest, 2e-3), Searched("left", 0.0, LARGEST_LEFT, 1e-3)),
        starts,
        lambda p, _c, _g: {"band": p[0] * swing, "jump": p[0] * (1.0 - p[1]) * swing},
        position=lambda held, p, _: stiction(held, p[0] * swing, p[1] * p[0] * swing),
        order=3,
        group="friction",
    )


def _slipping(dataset: Dataset, least: float) -> Effect:
    swing = dataset.swing
    return Effect(
        "stiction",
        Place.ACTUATOR,
        (Searched("band", least, LARGEST, 2e-3), Searched("jump", 0.05, 1.0, 1e-3)),
        [(band, jump) for band in _bands(dataset) for jump in (0.4, 0.8)],
        lambda p, _c, _g: {"band": p[0] * swing, "jump": p[0] * p[1] * swing},
        form="slipping",
        position=lambda held, p, _: slipped(held, p[0] * swing, p[1] * p[0] * swing),
        order=3,
        group="friction",
        price=2.0,
    )


def _turning(dataset: Dataset) -> Effect:
    swing = dataset.swing
    return Effect(
        "stiction",
        Place.ACTUATOR,
        (
            Searched("turn", 0.05, LARGEST, 0.0),
            Searched("plateau", 0.0, LARGEST, 0.0),
            Searched("left", -0.5, LARGEST, 1e-3),
            Searched("follow", 0.0, 1.0, 1e-3),
        ),
        [
            (turn, flat, left, follow)
            for turn in TURNS
            for flat in PLATEAUS
            for left, follow in ((0.0, 0.0), (0.2, 0.3))
        ],
        lambda p, _c, _g: {"band": (1.0 - p[2]) * swing, "jump": (1.0 - p[2]) * swing, "followed": p[3]},
        form=TURNING,
        position=lambda held, p, _: turned(held, (p[0] * swing, p[1] * swing), p[2] * swing, p[3]),
        order=3,
        group="friction",
        price=2.0,
    )


def _bands(dataset: Dataset) -> list[float]:
    """Return bands between the distinct moves of the output, in swings; a fixed row where it has too many."""
    moves = _moves(dataset)
    return _some((moves + np.append(SMALLEST, moves[:-1])) / 2.0) if moves.size else list(BANDS)


def _some(values: FloatArray) -> list[float]:
    """Return evenly picked ones of many values."""
    picked: list[float] = values[np.linspace(0, values.size - 1, min(MOST_BANDS, values.size)).astype(int)].tolist()
    return picked


def _moves(dataset: Dataset) -> FloatArray:
    """Return the distinct moves of the output, in swings; none where there are too many."""
    levels = dataset.data.held.levels
    if not 2 < levels.size <= MOST_CHANGES + 1:
        return np.zeros(0)
    distinct = np.unique(np.round(levels / dataset.swing, 3))
    apart: FloatArray = np.unique(np.round(np.abs(distinct[:, None] - distinct[None, :]), 3))
    apart = apart[(apart > SMALLEST) & (apart < LARGEST)]
    return apart[: apart.size if apart.size <= MOST_MOVES else 0]


def backlash(held: HeldInput, width: float, seat: float = 0.0, tilt: float = 0.0) -> HeldInput:
    """Return the position after a play that is `width (1 + tilt x)` wide at the position `x`.

    `seat` is where it starts within the play, -0.5 to 0.5.
    """
    x = start = seat * width
    if tilt == 0.0:
        return HeldInput(held.times, played(held.levels, width, start) - start)
    positions = []
    for level in held.levels.tolist():
        half = max(width * (1.0 + tilt * x), 0.0) / 2.0
        x = level - half if x < level - half else min(x, level + half)
        positions.append(x - start)
    return HeldInput(held.times, np.array(positions))


def played(levels: FloatArray, width: float, start: float, kept: FloatArray | None = None) -> FloatArray:
    """Return the position behind a play at each of some levels of a command, shape (N,).

    Each level moves the position into a range about itself, and two such moves are a move into a range again:
    `[min(max(a, c), d), min(max(b, c), d)]` for `[a, b]` and then `[c, d]`. All levels up to each one are put together
    in `log2 N` rounds (Hillis and Steele, Commun. ACM 29, 1986). With `kept`, the share of its distance from each level
    that the position keeps within the play, such a move is `min(max(gain x + offset, low), high)`.
    """
    low, high, reach = levels - width / 2.0, levels + width / 2.0, 1
    gain = np.ones(levels.size) if kept is None else kept
    offset = (1.0 - gain) * levels
    while reach < levels.size:
        least, most, by, to = low[reach:], high[reach:], gain[reach:], offset[reach:]
        ends = [np.minimum(np.maximum(by * end[:-reach] + to, least), most) for end in (low, high)]
        low, high = (np.concatenate((end[:reach], after)) for end, after in zip((low, high), ends, strict=True))
        if kept is not None:
            offset = np.concatenate((offset[:reach], by * offset[:-reach] + to))
            gain = np.concatenate((gain[:reach], by * gain[:-reach]))
        reach *= 2
    result: FloatArray = np.minimum(np.maximum(gain * start + offset, low), high)
    return result


def stiction(held: HeldInput, band: float, left: float) -> HeldInput:
    """Return the position of a valve that sticks within `band` and comes to rest `left` short of the command."""
    x = 0.0
    positions = []
    for level in held.levels.tolist():
        off = level - x
        if off > band:
            x = level - left
        elif off < -band:
            x = level + left
        positions.append(x)
    return HeldInput(held.times, np.array(positions))


def bands_alike(held: HeldInput, band: float, left: float) -> tuple[float, float]:
    """Return the least and the largest band, output units, at which a valve slips as it does at this one."""
    positions = stiction(held, band, left).levels
    off = np.abs(held.levels[1:] - positions[:-1])
    slips = positions[1:] != positions[:-1]
    return float(off[~slips].max(initial=left)), float(off[slips].min(initial=np.inf))


def slipped(held: HeldInput, band: float, jump: float) -> HeldInput:
    """Return the position of a valve that stops at every rest of its command and slips from there."""
    x = stopped = way = 0.0
    positions = []
    for level in held.levels.tolist():
        beyond = level - stopped
        least = (band + jump) / 2.0 if way == 0.0 else (jump if beyond * way > 0.0 else band)
        if abs(beyond) > least:
            way = math.copysign(1.0, beyond)
            x, stopped = level - way * (band - jump) / 2.0, level
        positions.append(x)
    return HeldInput(held.times, np.array(positions))


def turned(held: HeldInput, sizes: tuple[float, float], left: float, follow: float) -> HeldInput:
    """Return the position of a valve that slips where its command turns.

    Parameters
    ----------
    held : HeldInput
        The command.
    sizes : tuple of float
        How far back a turn goes, and how far from its extreme the command still waits there.
    left : float
        How short of the command the valve comes to rest.
    follow : float
        Share of the moves between two turns that it follows.
    """
    levels = held.levels
    found = turns_of(levels, *sizes)
    position = np.zeros(levels.size)
    for k, (at, extreme) in enumerate(found):
        end = found[k + 1][0] if k + 1 < len(found) else levels.size
        way = math.copysign(left, levels[extreme] - levels[at]) if at < levels.size else 0.0
        position[at:end] = levels[extreme] - way + follow * (levels[at:end] - levels[extreme])
    return HeldInput(held.times, position - position[0])


def turns_of(levels: FloatArray, back: float, flat: float) -> list[tuple[int, int]]:
    """Return where levels leave each extreme that they go back from by `back`, and where the extreme is."""
    found: list[tuple[int, int]] = []
    top = bottom = way = 0
    for k, level in enumerate(levels.tolist()):
        top = k if level > levels[top] else top
        bottom = k if level < levels[bottom] else bottom
        down, up = level < levels[top] - back, level > levels[bottom] + back
        if (way >= 0 and down) or (way <= 0 and up):
            extreme = top if way >= 0 and down else bottom
            if extreme > 0:  # where the record begins, nothing is known of a turn
                near = np.flatnonzero(np.abs(levels[extreme:k] - levels[extreme]) <= flat)
                found.append((extreme + int(near[-1]) + 1, extreme))
            way = -1 if extreme == top else 1
            top = bottom = k
    return found
