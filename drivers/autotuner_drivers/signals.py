"""What every driver checks about the signals it is asked for."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.errors import DeviceRefusedError, InputError

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping


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


def check_finite(values: Mapping[str, float]) -> None:
    """Raise `DeviceRefusedError` for the first value that is no number, before anything is written."""
    for name, value in values.items():
        if not math.isfinite(value):
            raise DeviceRefusedError("is not a finite number", field=name, value=value, remedy="Give a number.")
