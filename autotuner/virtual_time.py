"""Virtual time: an event loop whose clock jumps to the next deadline, for plants that are simulated."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable


def event_loop_factory(*, virtual: bool) -> Callable[[], asyncio.AbstractEventLoop] | None:
    """Return the event loop factory for `asyncio.Runner`: virtual time, or None for the default one."""
    if not virtual:
        return None
    import async_solipsism  # noqa: PLC0415 - only a simulated plant needs it

    return cast("Callable[[], asyncio.AbstractEventLoop]", async_solipsism.EventLoop)
