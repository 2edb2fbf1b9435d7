"""Interface of the compute pool for the code that drives a loop: no computation on the time of a control loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, ParamSpec, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

P = ParamSpec("P")
R = TypeVar("R")


class ComputePool(Protocol):
    """Runs a pure function somewhere."""

    async def run(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
        """Return the function's value, or raise its exception."""

    async def aside(self, function: Callable[[], R]) -> R:
        """Return the function's value, computed in a thread: milliseconds on the event loop would delay samples."""

    def interrupt(self) -> None:
        """End all computations at once; their callers get `ShuttingDownError`."""

    def close(self) -> None:
        """Give the workers back."""
