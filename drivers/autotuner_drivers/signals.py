"""What every driver checks about the signals it is asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Collection


def check_names(names: Collection[str], allowed: Collection[str], verb: str) -> None:
    """Raise `InputError` for the first signal that this backend cannot read or write; `verb` says which."""
    for name in names:
        if name not in allowed:
            raise InputError(
                f"is not a signal that this backend can {verb}",
                field="signal",
                value=name,
                remedy=f"Use one of {', '.join(sorted(allowed))}.",
            )
