"""Errors that carry their remedy.

Invariants:

1. Every error states the problem and the remedy.
2. An error about an input names the field and the value that was refused.
3. A refusal of an experiment (drifting PV, no oscillation) is NOT an error but a verdict: `autotuner.core.verdict`.
4. An error crosses from a worker process unharmed.
"""

from __future__ import annotations


class AutotunerError(Exception):
    """Base of all errors of this package.

    Parameters
    ----------
    message : str
        What is wrong, in one sentence without a final full stop.
    remedy : str
        What to do next.
    field : str, optional
        Dotted name of the input at fault, such as ``loops.TIC-101.sample_time_s``.
    value : object, optional
        The value that was refused.
    """

    def __init__(self, message: str, *, remedy: str, field: str | None = None, value: object = None) -> None:
        super().__init__(message)
        self.message = message
        self.remedy = remedy
        self.field = field
        self.value = value

    @property
    def finding(self) -> str:
        """The problem and its place, without the remedy, for callers that show the remedy separately."""
        place = f"{self.field}: " if self.field else ""
        shown = f" (got {_shorten(self.value)})" if self.value is not None else ""
        return f"{place}{self.message}{shown}"

    def __str__(self) -> str:
        return f"{self.finding}. {self.remedy}"

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuilt, (type(self), self.args, self.__dict__)

    def to_dict(self) -> dict[str, str | None]:
        """Return the parts as JSON-ready values."""
        return {
            "error": type(self).__name__,
            "message": self.message,
            "field": self.field,
            "value": None if self.value is None else _shorten(self.value),
            "remedy": self.remedy,
        }


def _shorten(value: object, limit: int = 80) -> str:
    try:
        text = repr(value)
    except RecursionError:  # thousands of brackets, one within the other
        text = f"{type(value).__name__}, nested too deeply to be shown"
    return text if len(text) <= limit else text[: limit - 3] + "..."


def _rebuilt(kind: type[AutotunerError], args: tuple[object, ...], state: dict[str, object]) -> AutotunerError:
    """Make an error of its parts, past a constructor that takes others."""
    error = kind.__new__(kind, *args)
    error.__dict__.update(state)
    return error


class InputError(AutotunerError):
    """A value given by the caller cannot be used."""


class ConfigurationError(InputError):
    """The configuration of the service, a loop or a driver is wrong."""


class RecordingError(InputError):
    """A recording cannot be read or used."""


class UnknownLoopError(InputError):
    """No loop of this name is configured."""


class UnknownTuningError(InputError):
    """No tuning has this identifier."""


class UnknownScheduleError(InputError):
    """No run over operating points has this identifier."""


class LoopBusyError(AutotunerError):
    """Another tuning holds the loop; `tuning_id` names it."""

    def __init__(self, loop: str, tuning_id: str) -> None:
        super().__init__(
            f"loop {loop} is held by tuning {tuning_id}",
            remedy="Wait until that tuning ends, or abort it.",
            field="loop",
            value=loop,
        )
        self.tuning_id = tuning_id


class OutputUnknownError(LoopBusyError):
    """A loop was disturbed, and no record states its original state: the loop is held until an operator confirms it."""

    def __init__(self, loop: str, lease: str, why: str) -> None:
        AutotunerError.__init__(
            self,
            f"the output of loop {loop} is unknown: lease {lease} was interrupted, and {why}",
            remedy=f"Set output and mode on the device by hand, then run `autotuner check --confirm {loop}`.",
            field="loop",
            value=loop,
        )
        self.tuning_id = lease


class TuningStateError(AutotunerError):
    """The state of the tuning does not allow the request."""


class GainsChangedError(AutotunerError):
    """The device holds other gains than those read or applied before: another program or an operator has set them."""


class ShuttingDownError(AutotunerError):
    """The service is stopping and starts nothing new."""

    def __init__(self) -> None:
        super().__init__("the service is stopping", remedy="Try again when it is back.")


class ComputationError(AutotunerError):
    """A computation could not be finished: its worker process was killed."""


class StorageError(AutotunerError):
    """The data directory cannot be used; the cause is chained."""


class DriverError(AutotunerError):
    """A device did not carry out a request; the cause is chained."""


class LinkError(DriverError):
    """The device cannot be reached, or the link was lost."""


class DeviceTimeoutError(LinkError):
    """The device did not answer in time."""


class DeviceRefusedError(DriverError):
    """The device answered, and refused."""
