"""Argument parser whose errors name the option, the value and the remedy.

Invariants:

1. Everything that can be checked from the command line alone is checked here, before a device is opened.
2. Options cannot be abbreviated: an abbreviation may become ambiguous with the next option.
3. A usage error is an `InputError`, as every other invalid input.
"""

from __future__ import annotations

import argparse
import math
import shutil
from dataclasses import dataclass
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, NoReturn

from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

WIDEST = 100
"""Most columns of a help text: longer lines are hard to read."""
REQUIRED = "the following arguments are required: "
"""Start of argparse's message about missing arguments."""


class UnusableValueError(argparse.ArgumentTypeError):
    """A value that an option cannot take: `message`, `value` and `remedy` become an `InputError` of the option."""

    def __init__(self, message: str, value: str, remedy: str) -> None:
        super().__init__(message)
        self.message, self.value, self.remedy = message, value, remedy


@dataclass(frozen=True, slots=True)
class Number:
    """A finite number from `low` to `high`; `above` excludes its value."""

    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf

    def __call__(self, text: str) -> float:
        """Return the number."""
        try:
            value = float(text)
        except ValueError:
            raise UnusableValueError("is not a number", text, "Give a number, such as 2.5.") from None
        if not math.isfinite(value):
            raise UnusableValueError("is not a finite number", text, "Give a finite number.")
        if value <= self.above:
            raise UnusableValueError(f"must be greater than {self.above:g}", text, "Give a larger number.")
        if not self.low <= value <= self.high:
            raise UnusableValueError("is out of range", text, f"Give a number {self._range()}.")
        return value

    def _range(self) -> str:
        low = "" if math.isinf(self.low) else f"of {self.low:g} or more"
        return f"from {self.low:g} to {self.high:g}" if math.isfinite(self.high) else low


@dataclass(frozen=True, slots=True)
class WholeNumber:
    """A whole number of at least `low`."""

    low: int

    def __call__(self, text: str) -> int:
        """Return the number."""
        try:
            value = int(text)
        except ValueError:
            raise UnusableValueError("is not a whole number", text, "Give a whole number, such as 2.") from None
        if value < self.low:
            raise UnusableValueError(f"must be {self.low} or more", text, "Give a larger number.")
        return value


@dataclass(frozen=True, slots=True)
class OneOf:
    """One of some choices, which `names` returns when they are needed: some take time to load."""

    names: Callable[[], Sequence[str]]

    def __call__(self, text: str) -> str:
        """Return the choice."""
        names = self.names()
        if text not in names:
            raise UnusableValueError("is not a choice", text, suggestion(text, names))
        return text


def words(*names: str) -> OneOf:
    """Return the type of an option with these choices."""
    return OneOf(lambda: names)


def suggestion(text: str, names: Iterable[str]) -> str:
    """Return a remedy: the nearest name, and all names."""
    known = list(names)
    near = get_close_matches(text, known, 1)
    return (f"Did you mean {near[0]}? " if near else "") + f"Use one of {', '.join(known)}."


class Help(argparse.HelpFormatter):
    """Help text that fits the terminal and leaves the lines of examples as they are."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28, width=min(shutil.get_terminal_size().columns, WIDEST) - 2)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if "\n" not in text:
            return super()._fill_text(text, width, indent)
        return "\n".join(indent + line for line in text.splitlines())


class Parser(argparse.ArgumentParser):
    """A parser that raises `InputError` for every wrong usage."""

    def __init__(self, **options: Any) -> None:
        plain: dict[str, Any] = {"allow_abbrev": False, "exit_on_error": False, "formatter_class": Help}
        super().__init__(**plain | options)

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Return the values of a whole command line.

        Raises
        ------
        InputError
            Names the option, the value and the remedy.
        """
        name = next((word for word in arguments if not word.startswith("-")), "")
        chosen = self.commands().get(name, self)
        try:
            values, rest = self.parse_known_args(arguments)
        except argparse.ArgumentError as error:
            raise chosen.refusal(error) from error
        if rest:
            raise chosen.unknown(rest[0])
        return values

    def error(self, message: str) -> NoReturn:
        """Raise `InputError` for a message of argparse."""
        raise self._refused(message)

    def _refused(self, message: str, argument: str | None = None) -> InputError:
        missing = message.removeprefix(REQUIRED)
        if missing != message:  # from Python 3.12.7 on an error of argparse, before a call of `error`
            return InputError("is missing", field=missing, remedy=self._see_help())
        return InputError(message, field=argument, remedy=self._see_help())

    def refusal(self, error: argparse.ArgumentError) -> InputError:
        """Return the `InputError` for an error of argparse."""
        cause = error.__context__
        if isinstance(cause, UnusableValueError):
            return InputError(cause.message, field=error.argument_name, value=cause.value, remedy=cause.remedy)
        return self._refused(error.message, error.argument_name)

    def unknown(self, word: str) -> InputError:
        """Return the refusal of an argument that is neither an option nor a positional argument here."""
        name = word.partition("=")[0]
        if not word.startswith("-"):
            return InputError("is one argument too many", field=self.prog, value=word, remedy=self._see_help())
        near = get_close_matches(name, self.options(), 1)
        meant = f"Did you mean {near[0]}? " if near else ""
        return InputError(
            f"is not an option of {self.prog}", field=name, value=word, remedy=f"{meant}{self._see_help()}"
        )

    def commands(self) -> dict[str, Parser]:
        """Return the parsers of the commands below this one by name."""
        found = [action for action in self._actions if isinstance(action, argparse._SubParsersAction)]  # noqa: SLF001
        return dict(found[0].choices) if found else {}

    def options(self) -> dict[str, argparse.Action]:
        """Return the options by their long names."""
        return {name: action for name, action in self._option_string_actions.items() if name.startswith("--")}

    def _see_help(self) -> str:
        return f"See `{self.prog} --help`."


def add_examples(parser: argparse.ArgumentParser, *lines: str) -> None:
    """Show examples below the options."""
    parser.epilog = "\n".join(["examples:", *(f"  {line}" for line in lines)])
