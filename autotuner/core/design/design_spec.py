"""The specification of a PID design: a goal by name or limits in numbers, and the purpose of the controller.

`Basis` is the input of a design: the model with its errors. `design_procedure` designs gains from both.

Invariants: a value that is not given follows from the goal. A specification is checked when it is made, so a
wrong one is refused before a loop moves.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any

from autotuner.core.design.requirements import (
    OVERSHOOT,
    Controller,
    Noise,
    NoiseLimit,
    Purpose,
    Requirements,
    requirements_for,
)
from autotuner.core.design.rules.rule_table import rule_named
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.design.device_controller import DeviceController
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel


EXPLAINED = 1.25
"""Misfit over the noise that was measured without a model up to which the misfit is noise: 2.5 standard errors of that
measure from some 500 samples."""


@dataclass(frozen=True, slots=True)
class DesignSpec:
    """Specification of gains.

    Attributes
    ----------
    goal : str
        ``calm``, ``balanced`` or ``brisk``; ignored when a rule or `Ms` is given.
    rule : str or None
        A tuning rule by name; the options below, except `tau_c_s`, are then ignored.
    Ms : float or None
        Largest sensitivity and complementary sensitivity, instead of the goal's.
    controller : str
        ``P``, ``PI`` or ``PID``: the parts that the controller may have.
    purpose : str
        ``load`` or ``set_point``: after which step the error is made small.
    tau_c_s : float or None
        Wanted closed-loop time constant, s.
    jitter : float or None
        Largest standard deviation of the output that noise and resolution may cause, output units; None: the goal's
        share of the output's span (`MOVEMENT`).

    Raises
    ------
    InputError
        An unknown name, or an invalid number; names the field.
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

    def requirements(self, noise: Noise | None = None, device: DeviceController | None = None) -> Requirements:
        """Return the spec as numbers for the robust design; without measured noise `jitter` limits nothing.

        For a device the design stays within its controller's capabilities, with the overshoot of the goal.
        """
        base = requirements_for(self.goal) if self.Ms is None else Requirements(Ms=self.Ms, Mt=self.Ms)
        limit = None
        if noise is not None and self.jitter is not None:
            limit = NoiseLimit(noise.sigma, self.jitter, noise.sample_time_s)
        free = replace(base, controller=Controller(self.controller), purpose=Purpose(self.purpose), noise=limit)
        if device is None:
            return free
        parts = free.controller if device.derivative or free.controller is Controller.P else Controller.PI
        overshoot = OVERSHOOT[self.goal] if self.Ms is None else OVERSHOOT["balanced"]
        ratio = device.derivative_ratio
        return replace(free, controller=parts, device=device, overshoot=overshoot, derivative_ratio=ratio)

    @property
    def name(self) -> str:
        """Short description of the specification."""
        if self.rule is not None:
            return self.rule
        limit = self.goal if self.Ms is None else f"Ms {self.Ms:g}"
        others = {
            self.controller: self.controller != Controller.PID,
            "set-point tracking": self.purpose == Purpose.SET_POINT,
            f"closed loop of {self.tau_c_s} s": self.tau_c_s is not None,
            f"jitter {self.jitter}": self.jitter is not None,
        }
        return ", ".join([limit, *(text for text, given in others.items() if given)])

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return asdict(self)


def noise_of(noise_sigma: float, rmse: float, sample_time_s: float, resolution: float = 0.0) -> Noise | None:
    """Return the noise of a record; None without any.

    Parameters
    ----------
    noise_sigma : float
        Standard deviation measured without a model, PV units: too large where the PV moves much between two samples,
        and, as a median of few samples, easily a tenth too small.
    rmse : float
        What the model leaves, PV units: by far the sharper figure, unless it is much larger because the model lacks
        something.
    sample_time_s : float
        Sample time, s.
    resolution : float
        Step of the sensor, PV units: rounding to it is noise of a step over the root of 12 (Widrow, 1956), at least.
    """
    measured = rmse if rmse <= EXPLAINED * noise_sigma else noise_sigma
    sigma = max(measured, resolution / math.sqrt(12.0))
    return Noise(sigma, sample_time_s) if 0.0 < sigma < math.inf and sample_time_s > 0.0 else None


def design_spec_from(entries: Mapping[str, Any]) -> DesignSpec:
    """Return the spec in the entries of a mapping that `DesignSpec.to_dict` made; missing keys take their defaults.

    Raises
    ------
    InputError
        As of `DesignSpec`.
    """
    return DesignSpec(**{field.name: entries[field.name] for field in fields(DesignSpec) if field.name in entries})


@dataclass(frozen=True, slots=True, eq=False)
class Basis:
    """Basis of a design.

    Attributes
    ----------
    model : ProcessModel
        The process.
    covariance : array of float, shape (p, p), or None
        Covariance of its parameters, where known.
    sample_time_s : float
        Sample time of the controller, s; 0 where that is not known.
    noise : Noise or None
        Measured noise.
    known_as : ProcessModel or None
        The same process by the parameters that the covariance is of, where those are others: see `MergedLags`.
    device : DeviceController or None
        The controller that will hold the gains; None: one that can hold all of a design.
    output_span : float
        Span of the output, output units: its movement is limited to a share of it; infinite where it is not known.
    """

    model: ProcessModel
    covariance: FloatArray | None = None
    sample_time_s: float = 0.0
    noise: Noise | None = None
    known_as: ProcessModel | None = None
    device: DeviceController | None = None
    output_span: float = math.inf
