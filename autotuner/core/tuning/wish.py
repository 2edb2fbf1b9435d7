"""What a user asks of gains: a goal in words or a limit in numbers, and what the controller is there for.

Rules of this file: what is left out follows from the goal; a wish is checked when it is made, so that nothing is moved
for one that cannot be met in words.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any

from autotuner.core.tuning.named_rules import rule_named
from autotuner.core.tuning.requirements import Controller, Noise, NoiseLimit, Purpose, Requirements, requirements_for
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.arrays import FloatArray
    from autotuner.core.process import ProcessModel


@dataclass(frozen=True, slots=True)
class Wish:
    """What is asked of gains.

    Attributes
    ----------
    goal : str
        ``calm``, ``balanced`` or ``brisk``; not looked at when a rule or `Ms` is given.
    rule : str or None
        A tuning rule by name; what follows is then not looked at, but for `tau_c_s`.
    Ms : float or None
        Largest sensitivity and complementary sensitivity, instead of the goal's.
    controller : str
        ``P``, ``PI`` or ``PID``: the parts that the controller may have.
    purpose : str
        ``load`` or ``set_point``: after which step the error is made small.
    tau_c_s : float or None
        Wanted closed-loop time constant, s.
    jitter : float or None
        Largest standard deviation of the output that the measured noise may cause, output units; None: any.

    Raises
    ------
    InputError
        A name that is none, or a number that is none; names the field.
    """

    goal: str = "balanced"
    rule: str | None = None
    Ms: float | None = None
    controller: str = Controller.PID.value
    purpose: str = Purpose.LOAD.value
    tau_c_s: float | None = None
    jitter: float | None = None

    def __post_init__(self) -> None:
        for name, names in (("controller", Controller), ("purpose", Purpose)):
            if getattr(self, name) not in [member.value for member in names]:
                known = ", ".join(member.value for member in names)
                raise InputError("is not known", field=name, value=getattr(self, name), remedy=f"Use one of {known}.")
        for name in ("tau_c_s", "jitter"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise InputError("must be positive", field=name, value=value, remedy="Leave it out for none.")
        if self.rule is not None:
            rule_named(self.rule)
        self.requirements()

    def requirements(self, noise: Noise | None = None) -> Requirements:
        """Return the wish as numbers for the robust design; without measured noise `jitter` limits nothing."""
        asked = requirements_for(self.goal) if self.Ms is None else Requirements(Ms=self.Ms, Mt=self.Ms)
        limit = None
        if noise is not None and self.jitter is not None:
            limit = NoiseLimit(noise.sigma, self.jitter, noise.sample_time_s)
        return replace(asked, controller=Controller(self.controller), purpose=Purpose(self.purpose), noise=limit)

    @property
    def name(self) -> str:
        """What was asked, in few words."""
        if self.rule is not None:
            return self.rule
        limit = self.goal if self.Ms is None else f"Ms {self.Ms:g}"
        others = {
            self.controller: self.controller != Controller.PID,
            "set-point tracking": self.purpose == Purpose.SET_POINT,
            f"closed loop of {self.tau_c_s} s": self.tau_c_s is not None,
            f"jitter {self.jitter}": self.jitter is not None,
        }
        return ", ".join([limit, *(text for text, asked in others.items() if asked)])

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return asdict(self)


def noise_of(noise_sigma: float, rmse: float, sample_time_s: float) -> Noise | None:
    """Return the noise of a record; None where there is none.

    Parameters
    ----------
    noise_sigma : float
        Standard deviation measured without a model, PV units: too large where the PV moves much between two samples.
    rmse : float
        What the model leaves, PV units: too large where it lacks something. The smaller of the two is taken.
    sample_time_s : float
        Sample time, s.
    """
    sigma = min(noise_sigma, rmse)
    return Noise(sigma, sample_time_s) if 0.0 < sigma < math.inf and sample_time_s > 0.0 else None


def wish_from(asked: Mapping[str, Any]) -> Wish:
    """Return the wish among the entries of a mapping, as `Wish.to_dict` made them; what is missing has its default.

    Raises
    ------
    InputError
        As of `Wish`.
    """
    return Wish(**{field.name: asked[field.name] for field in fields(Wish) if field.name in asked})


@dataclass(frozen=True, slots=True, eq=False)
class Basis:
    """What gains rest on.

    Attributes
    ----------
    model : ProcessModel
        The process.
    covariance : array of float, shape (p, p), or None
        Covariance of its parameters, where that is known.
    sample_time_s : float
        Sample time of the controller, s; 0 where that is not known.
    noise : Noise or None
        Measured noise.
    known_as : ProcessModel or None
        The same process by the parameters that the covariance is of, where those are others: see `MergedLags`.
    """

    model: ProcessModel
    covariance: FloatArray | None = None
    sample_time_s: float = 0.0
    noise: Noise | None = None
    known_as: ProcessModel | None = None
