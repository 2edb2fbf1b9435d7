"""Validation of values against a pydantic model: an error names key, value and remedy, not the library's terms.

Invariant: only the first fault is reported; the next one follows once that is corrected.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from pydantic import BaseModel, ValidationError

from autotuner.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping

M = TypeVar("M", bound=BaseModel)

SENTENCES = {
    "missing": "is missing",
    "extra_forbidden": "is not a known key",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be {ge:g} or more",
    "less_than_equal": "must be {le:g} or less",
    "finite_number": "is not a finite number",
    "float_type": "is not a number",
    "int_type": "is not a whole number",
    "bool_type": "is neither true nor false",
    "string_type": "is not a text",
    "string_too_short": "is empty",
    "literal_error": "must be {expected}",
    "enum": "must be {expected}",
    "tuple_type": "is not a list",
    "too_long": "has {actual_length} values, not {max_length}",
    "dict_type": "is not a table",
    "model_type": "is not a table",
}
"""Problems, by the library's name of the failure."""
REMEDIES = {
    "missing": "Add this key.",
    "extra_forbidden": "Remove it, or check its spelling against docs/configuration.md.",
    "greater_than": "Give a larger number.",
    "greater_than_equal": "Give a larger number.",
    "less_than_equal": "Give a smaller number.",
    "finite_number": "Give a finite number.",
    "float_type": "Give a number, without quotes.",
    "int_type": "Give a whole number, without quotes.",
    "bool_type": "Write true or false, without quotes.",
    "string_type": "Write it in quotes.",
    "string_too_short": "Give a text, or leave the key out.",
    "literal_error": "Use one of these.",
    "enum": "Use one of these.",
    "tuple_type": "Write it as [ ... ].",
    "too_long": "Remove the surplus entries.",
    "too_short": "Configure one loop at least.",
    "dict_type": "Write it as a table, under its own [ ] header or in { }.",
    "model_type": "Write it as a table, under its own [ ] header or in { }.",
}
"""Remedies, by the library's name of the failure."""
ANY_REMEDY = "Correct this key; the keys are described in docs/configuration.md."
UNSHOWN = frozenset({"missing"})
"""What has no value of its own: that of the table around it would be shown."""


def validated(kind: type[M], values: Mapping[str, object], source: str) -> M:
    """Return the values as an instance of a model.

    Raises
    ------
    ConfigurationError
        The first invalid value; its key is prefixed with `source`.
    """
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name, key = first["type"], ".".join(str(part) for part in first["loc"])
        known, theirs = SENTENCES.get(name), first["msg"]
        raise ConfigurationError(
            known.format_map(first.get("ctx", {})) if known else theirs[0].lower() + theirs[1:],
            field=f"{source}: {key}" if key else source,
            value=None if name in UNSHOWN else first["input"],
            remedy=REMEDIES.get(name, ANY_REMEDY),
        ) from error
