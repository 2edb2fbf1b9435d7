"""An effect: physics that the process model lacks, as a small object that extends the simulation.

    recorded output -> position (actuator) -> transport (dead time) -> process -> + columns (disturbances, modes) -> PV

Invariants:

1. An effect defines how it changes the simulation, never how it is fitted: numbers that enter linearly (a load's size,
   a curvature) are columns whose sizes are solved for; only the others are searched.
2. Several forms may share a name: a hard and a soft saturation are both `saturation`. What is reported is the name.
3. Searched numbers are dimensionless or in the record's own units, with bounds and starts taken from the record.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.zoh_input import HeldInput, unit_step

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray, IntArray
    from autotuner.core.model.step_responses import Motion


class Place(StrEnum):
    """Location of an effect in the loop."""

    ACTUATOR = "actuator"
    PROCESS = "process"
    DISTURBANCE = "disturbance"
    SENSOR = "sensor"


ROW = {Place.ACTUATOR: 0, Place.PROCESS: 5, Place.DISTURBANCE: 7, Place.SENSOR: 8}
"""Places of effects in the row from output to PV."""
ALIKE = 9
"""Values between two bounds that stand for all: what only a tenth of them do shows."""
ONE_LAG, TWO_LAGS = "third", "third and fourth"
"""Forms of further lags of a process with two of its own."""


@dataclass(frozen=True, slots=True)
class Searched:
    """A number that is searched for.

    Attributes
    ----------
    name : str
        Its name.
    low, high : float
        Bounds.
    step : float
        Step of the forward difference: larger where the simulation is a staircase in it; 0 for a number that stays
        where it starts.
    profiled : bool
        Whether its interval is found by trying values.
    """

    name: str
    low: float
    high: float
    step: float = 1e-5
    profiled: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Simulation as an effect sees it: one set of process parameters on one recording.

    Attributes
    ----------
    dataset : Dataset
        The recording.
    t : array of float, shape (N,)
        Times at which the PV is wanted, s from the start.
    delay_s : float
        Dead time, s.
    motion : Motion
        The process without gain and dead time.
    position : HeldInput
        Position of the actuator, output units as deviation from its start; as it arrives, the dead time left out.
    entering : HeldInput or None
        The position with loads added, where there are any.
    """

    dataset: Dataset
    t: FloatArray
    delay_s: float
    motion: Motion
    position: HeldInput
    entering: HeldInput | None = None

    @property
    def input(self) -> HeldInput:
        """Return the input of the process without the dead time: the position, and loads."""
        return self.position if self.entering is None else self.entering

    def forced(self, held: HeldInput, *, delayed: bool = True) -> FloatArray:
        """Return the unit-gain response of the process to an input."""
        response: FloatArray = self.motion.forced(held, self.t - self.delay_s if delayed else self.t)[0][0]
        return response

    def slopes_with_times(self, moments_s: FloatArray, moves: FloatArray) -> FloatArray:
        """Return the slope of the unit-gain response with the time of each move of the input, shape (N, M)."""
        since = (self.t - self.delay_s)[:, None] - moments_s
        answer = self.motion.forced(unit_step(0.0), np.maximum(since, 0.0))[1][0]
        slopes: FloatArray = np.where(since > 0.0, -moves * answer, 0.0)
        return slopes


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Samples, and what a model leaves of them to one of its effects.

    Attributes
    ----------
    view : View
        The simulation, at all samples until the last of these.
    rows : array of int, shape (N,)
        The samples.
    left : array of float, shape (N,)
        PV there, less everything but what the effect itself adds to it.
    gain : float
        Gain of the process, PV per output.
    alone : bool
        Whether nothing else acts on the input of the process, or on its response.
    """

    view: View
    rows: IntArray
    left: FloatArray
    gain: float
    alone: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Effect:
    """One effect in one form.

    Attributes
    ----------
    name, place
        What is reported.
    form : str
        Which of the name's forms.
    searched : tuple of Searched
        Numbers that are searched for.
    starts : sequence of tuple of float
        Values of `searched` from which a search may begin; the best few are taken.
    position : callable, optional
        Changes the input on its way to the process.
    transport : callable, optional
        From the position, the values of `searched` and the dead time, s, to the delayed input of the process:
        a variable dead time.
    response : callable, optional
        Takes the place of the process's unit-gain response to the position.
    columns : callable, optional
        Adds columns to the PV.
    slopes : callable, optional
        Slopes of the unit-gain response with all that is searched for, where they are known at once.
    load : callable, optional
        From the values of `searched` and the recording, a load at the input of the process, output units.
    sizes : callable
        From the values of `searched`, the sizes of `columns` and the gain to the reported sizes, in engineering units.
    order : int, optional
        Place in the row of effects from output to PV; 0 to 4 in the actuator, where nothing else is given that of its
        place.
    price : float
        Additional penalty besides its parameters.
    group : str
        Effects of one group are equivalent on a record and are not named together.
    measured : bool
        Whether it comes from a further column of the record: knowledge, not a guess.
    unseen_after : bool
        Whether the part that is not fitted need not show it.
    makes_late : bool
        Whether the process alone replaces it by dead time: the search then starts with less dead time too.
    takes_third : bool
        Whether its response is also that of a process of three lags.
    clocked : bool
        Whether it acts at even times: what is searched is the logarithm of a period, s, and a phase, periods.
    reads_as : callable, optional
        From the sizes of `columns`, the name that is reported: of a free form, that of the shape that it takes.
    means : callable, optional
        From the values of `searched`, the sizes of `columns`, the gain and the process's own numbers (see `Structure`),
        whether they agree with the name: a zero on the right side, a mode slower than the process. True without it.
    lateness_s : callable, optional
        From the values of `searched`, the standard deviation of the lateness of moves that nothing was fitted to, s.
    alike : callable, optional
        From the values of `searched` and a time, s, other values that nothing until then distinguishes from them.
    seen_again : callable, optional
        From samples, the effect as those show it, None where they do not: for numbers that no fit can move, since they
        are known to a sample, or are of a single event.
    blur : callable, optional
        From the values of `searched`, by how much the record leaves sizes open on either side, whatever the noise.
    other_forms : tuple of Effect
        Forms of the same name, or of another one for the same physics, that are tried in its place once it was found:
        a search does not need them to come to it. Numbers of the same name begin where they were found.
    next_terms : tuple of Effect
        The effect with a next term of its series, each: `searched` or `columns` have one more at their end. They are
        never reported, but show what the form leaves open.
    """

    name: str
    place: Place
    searched: tuple[Searched, ...]
    starts: Sequence[tuple[float, ...]]
    sizes: Callable[[Sequence[float], Sequence[float], float], Mapping[str, float]]
    form: str = ""
    position: Callable[[HeldInput, Sequence[float], Dataset], HeldInput] | None = None
    transport: Callable[[HeldInput, Sequence[float], float, Dataset], HeldInput] | None = None
    response: Callable[[View, Sequence[float]], FloatArray] | None = None
    columns: Callable[[View, Sequence[float]], Sequence[FloatArray]] | None = None
    slopes: Callable[[View, Sequence[float]], FloatArray] | None = None
    load: Callable[[Sequence[float], Dataset], HeldInput] | None = None
    order: int | None = None
    price: float = 0.0
    group: str = ""
    measured: bool = False
    unseen_after: bool = False
    makes_late: bool = False
    takes_third: bool = False
    clocked: bool = False
    reads_as: Callable[[Sequence[float]], str] | None = None
    means: Callable[[Sequence[float], Sequence[float], float, Sequence[float]], bool] | None = None
    lateness_s: Callable[[Sequence[float]], float] | None = None
    alike: Callable[[Sequence[float], float], Sequence[Sequence[float]]] | None = None
    seen_again: Callable[[Seen], Effect | None] | None = None
    blur: Callable[[Sequence[float]], Mapping[str, float]] | None = None
    other_forms: tuple[Effect, ...] = ()
    next_terms: tuple[Effect, ...] = ()

    @property
    def rank(self) -> int:
        """Place in the row of effects from output to PV."""
        return ROW[self.place] if self.order is None else self.order

    @property
    def key(self) -> str:
        """Name and form."""
        return f"{self.name}:{self.form}" if self.form else self.name

    @property
    def only_adds(self) -> bool:
        """Whether it does nothing but add columns: input and response of the process do not depend on its numbers."""
        return self.position is None and self.transport is None and self.response is None and self.load is None


def between(lowest: float, highest: float) -> FloatArray:
    """Return values that stand for all between two bounds; empty where there are none."""
    return lowest + (highest - lowest) * (np.arange(ALIKE if lowest < highest else 0) + 0.5) / ALIKE
