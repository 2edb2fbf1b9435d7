"""Common interface of the literature's methods: a trial holds the recordings, a method names the one it uses.

What the thesis gives to its own method is given to all that ask for it: the static gain, and for a second-order process
the dead time, which it reads off the record by eye.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.identification.result import Estimate, refuse
from autotuner.core.signals.limit_cycle import measure_limit_cycle
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from autotuner.core.design.gains import PidGains
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner.core.signals.limit_cycle import LimitCycle

SYMMETRIC, BIASED, HYSTERESIS, DELAYED, BESIDE = "symmetric", "biased", "hysteresis", "delayed", "beside"
STEP = "step"
"""Tests: an ideal relay about rest, an asymmetric one, one with a dead zone, one with more dead time in the loop, one
in parallel with a controller (the recorded output is the relay's own), a step."""
FOPDT, SOPDT = ("fopdt",), ("sopdt_overdamped", "sopdt_underdamped")


@dataclass(frozen=True, slots=True)
class Trial:
    """A process under test.

    Attributes
    ----------
    structure : str
        Structure of the model wanted.
    K : float
        Static gain as given to the methods, PV/output.
    D : float
        Dead time as given to those that cannot find it, s.
    tests : mapping of str to Recording
        Recordings by the name of the test; those with a relay begin at rest.
    added_delay_s : float
        Delay of the relay of the test ``delayed``, s.
    controller : PidGains or None
        Controller in parallel with the relay of the test ``beside``.
    """

    structure: str
    K: float
    D: float
    tests: Mapping[str, Recording]
    added_delay_s: float = 0.0
    controller: PidGains | None = None

    @property
    def first_order(self) -> bool:
        """Whether a first-order model is wanted."""
        return self.structure in FOPDT

    def recording(self, test: str) -> Recording:
        """Return the recording of a test; raise `InputError` when it was not made."""
        if test not in self.tests:
            raise InputError("was not made", field=f"tests.{test}", remedy="Record it.")
        return self.tests[test]

    def cycle(self, test: str) -> LimitCycle:
        """Return the limit cycle of a test; raise `InputError` when it holds none."""
        cycle = measure_limit_cycle(self.recording(test))
        if cycle is None:
            raise InputError("holds no steady oscillation", field=f"tests.{test}", remedy="Record for longer.")
        return cycle


@dataclass(frozen=True, slots=True)
class Method:
    """A method.

    Attributes
    ----------
    name : str
        Stable name.
    title : str
        Name for people, with its authors.
    structures : tuple of str
        Structures of the models that it returns.
    estimate : callable
        Returns the model of a trial; raises `InputError` where the method does not apply.
    finds_all : bool
        Whether the method also identifies static gain and dead time, which others are given.
    finds : tuple of str
        Which of these two it identifies, where not both.
    """

    name: str
    title: str
    structures: tuple[str, ...]
    estimate: Callable[[Trial], ProcessModel]
    finds_all: bool = False
    finds: tuple[str, ...] = ()

    def given(self, structure: str) -> set[str]:
        """Return the parameters that are given to it, so that their errors say nothing of the method."""
        names = set() if self.finds_all else {"K"} if structure in FOPDT else {"K", "D"}
        return names - set(self.finds)

    def apply(self, trial: Trial) -> Estimate:
        """Return the model, or the reason for its absence."""
        if trial.structure not in self.structures:
            return refuse(self.name, f"has no formula for the structure {trial.structure}")
        try:
            return Estimate(self.name, self.estimate(trial))
        except InputError as error:
            return refuse(self.name, f"{error.field} {error.message}")
