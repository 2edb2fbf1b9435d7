"""Where pure functions run, as the code that drives a loop sees it: never on the time of a control loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, ParamSpec, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

P = ParamSpec("P")
R = TypeVar("R")


class ComputePool(Protocol):
    """Runs a pure function somewhere."""

    async def run(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
        """Return the function's value, or raise what it raised."""

    async def aside(self, function: Callable[[], R]) -> R:
        """Return the function's value, called beside the event loop: what takes milliseconds makes samples late."""

    def interrupt(self) -> None:
        """End all work at once, without waiting; who waits for it gets `ShuttingDownError`."""

    def close(self) -> None:
        """Give the workers back."""
