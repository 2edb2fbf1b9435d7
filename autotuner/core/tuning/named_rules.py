"""The rows of the table of rules by their names."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.tuning.rule_table import RULES
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.tuning.rule_table import Rule


def rule_names() -> tuple[str, ...]:
    """Return the names of all rules, in the order of the table."""
    return tuple(RULES)


def rule_named(name: str) -> Rule:
    """Return the row of that name; capitals, blanks and hyphens do not matter.

    Raises
    ------
    InputError
        No rule has this name; the remedy lists all.
    """
    key = str(name).strip().lower().replace("-", "_").replace(" ", "_")
    if key not in RULES:
        raise InputError(
            "is not a known tuning rule", field="rule", value=name, remedy=f"Use one of {', '.join(RULES)}."
        )
    return RULES[key]
