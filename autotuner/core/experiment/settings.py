"""Settings of an experiment, checked at creation.

Invariants: every field has a unit and a default that is safe for an unknown process; a value that cannot work
is refused here, by name, before anything moves.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Literal

from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.design.gains import PidGains


Side = Literal["heat", "cool"]
"""The side of output zero on which a relay stays."""


RESPONSE_SAMPLES = 500
"""Longest wait for the PV's first answer, samples: a loop is sampled ten to a hundred times in its dead time."""
SHORTEST_RESPONSE_LIMIT_S = 60.0
"""The same for a loop that is sampled more quickly than that, s."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the output and of the PV.

    Attributes
    ----------
    output : tuple of float
        Lowest and highest output, output units.
    pv : tuple of float
        Lowest and highest PV, engineering units; the experiment is stopped outside.
    output_slew_per_s : float
        Fastest change of the output, output units/s; infinite when not limited.
    safe_output : float or None
        Where the output goes when a tuning is stopped by a limit; None: back to the output before the tuning.
    at_end : str
        ``restore``: the output before the tuning; ``safe``: the safe output at every end of a tuning that found its
        loop in manual, for a board that holds its last output.
    """

    output: tuple[float, float] = (0.0, 100.0)
    pv: tuple[float, float] = (-math.inf, math.inf)
    output_slew_per_s: float = math.inf
    safe_output: float | None = None
    at_end: str = "restore"

    def __post_init__(self) -> None:
        if self.at_end == "safe" and self.safe_output is None:
            raise InputError(
                "needs limits.safe_output",
                field="limits.at_end",
                value=self.at_end,
                remedy="Declare the safe output, or restore the output before the tuning.",
            )
        for name in ("output", "pv"):
            low, high = getattr(self, name)
            if not low < high:
                raise InputError(
                    "must be [low, high] with low under high",
                    field=f"limits.{name}",
                    value=[low, high],
                    remedy="Swap or widen the two values.",
                )
        if not all(map(math.isfinite, self.output)):
            raise InputError(
                "must be finite", field="limits.output", value=list(self.output), remedy="Give the actuator's range."
            )
        _positive("limits.output_slew_per_s", self.output_slew_per_s)
        if self.safe_output is not None and not self.output[0] <= self.safe_output <= self.output[1]:
            raise InputError(
                f"must lie within the output limits {self.output[0]:g} to {self.output[1]:g}",
                field="limits.safe_output",
                value=self.safe_output,
                remedy="Choose a value inside.",
            )


@dataclass(frozen=True, slots=True)
class ExperimentSettings:
    """Settings of the relay experiment.

    Attributes
    ----------
    sample_time_s : float
        Time between samples, s.
    limits : Limits
        Output, slew and PV limits.
    direct : bool
        Whether a higher output raises the PV (a heater) or lowers it (a cooler).
    amplitude : float or None
        Half the relay swing, output units; None: a tenth of the output range.
    ratio : float
        Upper part over lower part of the swing about the present output; 1 is the symmetric relay.
    pv_amplitude : float or None
        Requested amplitude of the PV's oscillation, zero to peak, PV units, to which the relay amplitude is adapted;
        None: six times the measured noise at least.
    max_amplitude : float or None
        Largest relay amplitude that adaptation may reach, output units; None: `amplitude` where that is given, else a
        quarter of the output range.
    side : {"heat", "cool"} or None
        Keeps the relay on one side of output zero, for an output that heats above it and cools below it.
    drift_compensation : bool
        Whether a PV that drifts at rest is followed however fast it is (see `experiment/baseline.py`). Without it a
        drift of up to half the amplitude of the oscillation in each period is followed, and a faster one refused.
    hysteresis : float or None
        Half width of the relay's dead zone, PV units; None: three times the measured noise.
    quiet_s : float or None
        Time to watch the loop at rest, s; None: 50 samples.
    min_periods, max_periods : int
        Fewest and most full periods of oscillation.
    accuracy : float
        Relative standard error of period and amplitude at which the relay stops.
    check : bool
        Whether the half-amplitude relay, the staircase and the tail follow (see `core/check.py`).
    response_limit_s : float or None
        Longest wait for the PV's first response, and for any half period before a period is known, s; None: 500 samples
        and a minute at least, and for a half period ten times the one before too.
    time_limit_s : float
        Longest time for everything, s.
    online : PidGains or None
        A controller in parallel with the relay (see `parallel_controller`); None: the relay alone.
    """

    sample_time_s: float = 1.0
    limits: Limits = field(default_factory=Limits)
    direct: bool = True
    amplitude: float | None = None
    ratio: float = 2.0
    pv_amplitude: float | None = None
    max_amplitude: float | None = None
    side: Side | None = None
    drift_compensation: bool = False
    hysteresis: float | None = None
    quiet_s: float | None = None
    min_periods: int = 3
    max_periods: int = 12
    accuracy: float = 0.01
    check: bool = True
    response_limit_s: float | None = None
    time_limit_s: float = 86400.0
    online: PidGains | None = None

    def __post_init__(self) -> None:
        for name in ("sample_time_s", "accuracy", "time_limit_s"):
            _positive(name, getattr(self, name))
        for name in ("amplitude", "pv_amplitude", "max_amplitude", "hysteresis", "quiet_s", "response_limit_s"):
            if getattr(self, name) is not None:
                _positive(name, getattr(self, name), zero_allowed=name == "hysteresis")
        _within("ratio", self.ratio, 1.0, 5.0)
        if self.max_periods < 2:
            raise InputError(
                "must be 2 or more", field="max_periods", value=self.max_periods, remedy="Give a larger number."
            )
        _within("min_periods", self.min_periods, 2, self.max_periods)
        self._check_swing()
        if self.online is not None and self.drift_compensation:
            raise InputError(
                "does not go with a controller beside the relay, which takes a drift away itself",
                field="drift_compensation",
                value=True,
                remedy="Leave one of the two out.",
            )
        if self.online is not None and (self.online.Kp > 0.0) != self.direct:
            raise InputError(
                f"must be {'positive' if self.direct else 'negative'} where a higher output "
                f"{'raises' if self.direct else 'lowers'} the PV: with this sign the controller would run away",
                field="online.Kp",
                value=self.online.Kp,
                remedy="Turn the sign of Kp, or correct the action of the loop.",
            )

    def _check_swing(self) -> None:
        """Refuse amplitudes that the range of the relay does not allow."""
        low, high = self.limits.output
        if self.side is not None and not low < 0.0 < high:
            raise InputError(
                f"needs an output that heats above zero and cools below it, but its limits are {low:g} to {high:g}",
                field="side",
                value=self.side,
                remedy="Leave it out, or correct limits.output.",
            )
        low, high = self.relay_limits
        for name in ("amplitude", "max_amplitude"):
            value = getattr(self, name)
            if value is not None and 2.0 * value > high - low:
                raise InputError(
                    f"swings {2.0 * value:g}, more than the output range {low:g} to {high:g} allows",
                    field=name,
                    value=value,
                    remedy=f"Give {(high - low) / 2.0:g} at most: the amplitude is half the swing.",
                )
        if self.largest_amplitude < self.half_swing:
            raise InputError(
                f"is less than the amplitude of {self.half_swing:g} that the relay starts with",
                field="max_amplitude",
                value=self.max_amplitude,
                remedy="Raise it, or give a smaller amplitude.",
            )

    @property
    def relay_limits(self) -> tuple[float, float]:
        """Lowest and highest output of the relay, output units."""
        low, high = self.limits.output
        return {None: (low, high), "heat": (0.0, high), "cool": (low, 0.0)}[self.side]

    @property
    def half_swing(self) -> float:
        """The relay amplitude at the start, output units."""
        low, high = self.relay_limits
        return (high - low) / 10.0 if self.amplitude is None else self.amplitude

    @property
    def largest_amplitude(self) -> float:
        """The relay amplitude that adaptation may reach, output units."""
        low, high = self.relay_limits
        if self.max_amplitude is not None:
            return self.max_amplitude
        return (high - low) / 4.0 if self.amplitude is None else self.amplitude

    @property
    def quiet_duration_s(self) -> float:
        """The quiet time in force, s."""
        return 50.0 * self.sample_time_s if self.quiet_s is None else self.quiet_s

    @property
    def longest_response_s(self) -> float:
        """The longest wait for the PV's first answer in force, s."""
        if self.response_limit_s is not None:
            return self.response_limit_s
        return max(RESPONSE_SAMPLES * self.sample_time_s, SHORTEST_RESPONSE_LIMIT_S)

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values; infinite limits become None."""
        values = asdict(self)
        values["limits"] = {
            name: [_finite(v) for v in value] if isinstance(value, tuple) else _finite(value)
            for name, value in values["limits"].items()
        }
        return values | {"online": None if self.online is None else self.online.to_dict()}


def _finite(value: float | str | None) -> float | str | None:
    return value if isinstance(value, str) or (value is not None and math.isfinite(value)) else None


def _positive(name: str, value: float, *, zero_allowed: bool = False) -> None:
    if not (value > 0.0 or (zero_allowed and value == 0.0)):
        raise InputError(
            "must not be negative" if zero_allowed else "must be positive",
            field=name,
            value=value,
            remedy=f"Give a {'non-negative' if zero_allowed else 'positive'} number.",
        )


def _within(name: str, value: float, lowest: float, highest: float) -> None:
    if not lowest <= value <= highest:
        raise InputError(
            f"must lie between {lowest:g} and {highest:g}", field=name, value=value, remedy="Choose a value inside."
        )
