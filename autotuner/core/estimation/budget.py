"""The end of a search for lack of time: the caller knows the time, the search asks whether it is spent.

`core` reads no clock. A caller gives a function that returns whether the time is spent; the search asks it before every
evaluation of a model, which takes well under a millisecond, and ends with `BudgetSpentError`.
"""

from __future__ import annotations

from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_is_spent: ContextVar[Callable[[], bool] | None] = ContextVar("is_spent", default=None)


class BudgetSpentError(Exception):
    """The time for a search is spent; caught by the one who gave it."""


@contextmanager
def within(is_spent: Callable[[], bool]) -> Iterator[None]:
    """Make every search in this context end when the time is spent."""
    token = _is_spent.set(is_spent)
    try:
        yield
    finally:
        _is_spent.reset(token)


def require_time() -> None:
    """Return while there is time, or no budget.

    Raises
    ------
    BudgetSpentError
        The time is spent.
    """
    is_spent = _is_spent.get()
    if is_spent is not None and is_spent():
        raise BudgetSpentError
