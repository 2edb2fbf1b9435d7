"""Port between the tuner and a device: four calls in plain types.

Invariants:

1. A backend moves numbers; it never decides. Limits, slew and restore belong to the controller.
2. Values are in the loop's engineering and output units; scaling is the driver's work.
3. A failure is a `autotuner.errors.DriverError` with its cause chained, never a default value. A value that the device
   reports as invalid (a broken sensor) is NaN.
4. No call blocks the event loop, and every call ends: with a result, an error, or its cancellation.

A backend without hardware may have an attribute `simulated = True`: it depends on the event loop's clock alone and may
therefore run in virtual time. Optional protocols: `Timed` for the time of a measurement within a call, `Repeating` for
repeated requests, `Ranged` for the range and resolution of the device, `Watchful` for the detection of a lost device
between calls, `LineSharing` for a line that serves several loops, `Carried` for a device in memory.

A driver package announces a factory under the entry point group ``autotuner.drivers``; an external driver has the same
rights as a built-in one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

PV: Final = "pv"
"""Process variable, engineering units. Every backend can read it."""
OUTPUT: Final = "output"
"""Controller output, output units. Every backend can write it; reading it back is optional."""
SET_POINT: Final = "set_point"
"""Set point of the device's own controller, engineering units. Optional."""
MANUAL_OUTPUT: Final = "manual_output"
"""Output that the device takes when it goes to manual. Optional: a device without it is taken to follow in auto."""
AUTO: Final = "auto"
"""1.0 while the device's own controller drives the output, 0.0 in manual. Optional."""
FIRST_PAUSE_S: Final = 0.1
"""Pause after the first failed attempt to reach a device, s; each later one is twice as long."""
LONGEST_PAUSE_S: Final = 2.0
"""Longest pause between two attempts, s: as long as a loop may wait for a device that is there again."""


@runtime_checkable
class Backend(Protocol):
    """Connection of one loop to its device."""

    @property
    def readable(self) -> frozenset[str]:
        """Names of the signals that `read` accepts; contains ``pv``."""

    @property
    def writable(self) -> frozenset[str]:
        """Names of the signals that `write` accepts; contains ``output``."""

    async def open(self) -> None:
        """Connect. Opening an open backend does nothing; a backend may be opened again after `close`."""

    async def read(self, names: Collection[str]) -> dict[str, float]:
        """Return the present value of each named signal, read together where the device allows it."""

    async def write(self, values: Mapping[str, float]) -> None:
        """Set the named signals, in the order given; return once the device has accepted them."""

    async def close(self) -> None:
        """Disconnect. Idempotent; never raises for a link that is already dead."""


@runtime_checkable
class Timed(Protocol):
    """A backend that reports the time of each exchange, which differs from the end of a call that needed retries."""

    @property
    def moment_s(self) -> float:
        """Time on the event loop's clock, s, of the last call's last signal: when the PV was measured, the output set.

        The best guess, such as the middle between the request and the answer that counted; NaN before any call.
        """


@runtime_checkable
class Repeating(Protocol):
    """A backend that repeats a request after a missing or damaged answer."""

    @property
    def repeated(self) -> int:
        """Number of repeated requests since the backend was created."""


@runtime_checkable
class Ranged(Protocol):
    """A backend that reports the range that its device can hold."""

    def limits(self, name: str) -> tuple[float, float]:
        """Return the lowest and highest value of a signal in the device; infinite where there is no limit."""


@runtime_checkable
class Watchful(Protocol):
    """A backend that detects a lost device without a call."""

    def watch(self, gone: Callable[[str], None] | None) -> None:
        """Call `gone` with the reason as soon as the device has closed the link and takes no new one; None ends it."""


@runtime_checkable
class LineSharing(Protocol):
    """A backend whose line serves several loops, with common requests for readings at the same time."""

    def counted_from(self, now_s: float) -> float:
        """Return the time on the event loop's clock, s, from which all loops on the line count their periods.

        It is `now_s` of the first loop that calls, so that a single loop does not wait.
        """


@runtime_checkable
class Carried(Protocol):
    """A backend whose device lives in memory, and is passed to the process that drives it, and back."""

    def carried(self) -> object:
        """Return the device, which may be pickled; None where another backend shares it, so that it has to stay."""

    def take_over(self, device: object) -> None:
        """Be the connection to a device that `carried` returned, in whatever process that was."""


class BackendFactory(Protocol):
    """Factory that a driver announces: returns a closed backend for its table of the configuration."""

    def __call__(self, options: Mapping[str, object]) -> Backend:
        """Return a closed backend; raise `autotuner.errors.ConfigurationError` naming the key, value and remedy."""
