"""Parsing of a driver's options, and checks of the signals that are requested from a driver.

Invariants:

1. Every error names the key (`registers.pv.type`), the given value and the correction.
2. An unknown key is an error too: a misspelt `timeout` must not silently leave the default in force.
"""

from __future__ import annotations

import difflib
import importlib
import math
import os
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn, TypeGuard, TypeVar

from autotuner.errors import ConfigurationError, DeviceRefusedError, InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator
    from types import ModuleType


T = TypeVar("T")
_REQUIRED: Final = object()


def refuse(key: str, value: object, message: str, remedy: str) -> NoReturn:
    """Raise the `ConfigurationError` of one key."""
    raise ConfigurationError(message, field=key, value=value, remedy=remedy)


class Options:
    """One table of options: values are taken by name, and `done` refuses unknown keys.

    Parameters
    ----------
    values : mapping
            The table, as parsed from the configuration file.
        path : str
            Path of the table, such as ``registers.pv``; empty for the driver's own table.

    Raises
    ------
    ConfigurationError
        `values` is not a table.
    """

    def __init__(self, values: object, path: str = "") -> None:
        self.path = path
        if not isinstance(values, Mapping):
            refuse(path, values, "must be a table", "Write it as { key = value, ... }.")
        self.values: Mapping[str, object] = values
        self._known: set[str] = set()

    def key(self, name: str) -> str:
        """Return the dotted name of a key of this table."""
        return f"{self.path}.{name}" if self.path else name

    def number(
        self, name: str, default: object = _REQUIRED, *, low: float = -math.inf, high: float = math.inf, unit: str = ""
    ) -> float:
        """Return a finite number within `low` and `high`."""
        value = self._take(name, default)
        if isinstance(value, bool) or not _is_finite(value):
            refuse(self.key(name), value, "must be a number", f"Write {name} = 1.0, for instance.")
        if not low <= value <= high:
            refuse(self.key(name), value, "is out of range", f"Give {_range(low, high)}{unit and ' ' + unit}.")
        return float(value)

    def integer(self, name: str, default: object = _REQUIRED, *, low: int, high: int) -> int:
        """Return a whole number within `low` and `high`."""
        value = self._take(name, default)
        if isinstance(value, bool) or not isinstance(value, int):
            refuse(self.key(name), value, "must be a whole number", f"Give {_range(low, high)}.")
        if not low <= value <= high:
            refuse(self.key(name), value, "is out of range", f"Give {_range(low, high)}.")
        return value

    def integers(self, name: str) -> tuple[int, ...]:
        """Return a list of whole numbers; empty when the key is absent."""
        value = self._take(name, ())
        if not isinstance(value, list | tuple) or any(isinstance(v, bool) or not isinstance(v, int) for v in value):
            refuse(self.key(name), value, "must be a list of whole numbers", f"Write {name} = [32767], for instance.")
        return tuple(value)

    def number_list(self, name: str, default: object = _REQUIRED) -> tuple[float, ...]:
        """Return a list of finite numbers."""
        value = self._take(name, default)
        if not isinstance(value, list | tuple) or any(isinstance(v, bool) or not _is_finite(v) for v in value):
            refuse(self.key(name), value, "must be a list of numbers", f"Write {name} = [1.0, 2.0], for instance.")
        return tuple(float(v) for v in value)

    def span(self, name: str, default: tuple[float, float]) -> tuple[float, float]:
        """Return two ascending numbers, such as `[0.0, 100.0]`."""
        if name not in self:
            self._known.add(name)
            return default
        bounds = self.number_list(name)
        if len(bounds) != 2 or not bounds[0] < bounds[1]:
            refuse(self.key(name), list(bounds), "must be two ascending numbers", f"Write {name} = [0.0, 100.0].")
        return bounds[0], bounds[1]

    def tables(self, name: str) -> list[Options]:
        """Return a list of tables; empty when the key is absent."""
        value = self._take(name, ())
        if not isinstance(value, list | tuple):
            refuse(self.key(name), value, "must be a list of tables", f"Write {name} = [{{ key = value }}].")
        return [Options(item, f"{self.key(name)}[{i}]") for i, item in enumerate(value)]

    def flag(self, name: str, *, default: bool) -> bool:
        """Return true or false."""
        value = self._take(name, default)
        if not isinstance(value, bool):
            refuse(self.key(name), value, "must be true or false", f"Write {name} = true or {name} = false.")
        return value

    def text(self, name: str, default: object = _REQUIRED) -> str:
        """Return a text that is not empty."""
        value = self._take(name, default)
        if not isinstance(value, str) or not value:
            refuse(self.key(name), value, "must be a text", f'Write {name} = "...".')
        return value

    def choice(self, name: str, choices: Collection[T], default: object = _REQUIRED) -> T:
        """Return one of `choices`."""
        value = self._take(name, default)
        for choice in choices:
            if choice == value and type(choice) is type(value):
                return choice
        refuse(self.key(name), value, "is not known", f"Use one of {', '.join(map(str, choices))}.")

    def value(self, name: str, default: object = _REQUIRED) -> object:
        """Return a value of any type."""
        return self._take(name, default)

    def table(self, name: str, default: object = _REQUIRED) -> Options:
        """Return a table within this one."""
        return Options(self._take(name, default), self.key(name))

    def __contains__(self, name: str) -> bool:
        """Return whether the key is present."""
        return name in self.values

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the keys that are present."""
        return iter(self.values)

    def done(self) -> None:
        """Refuse the keys that were not taken."""
        for name in self.values:
            if name not in self._known:
                matches = difflib.get_close_matches(str(name), self._known, n=1)
                hint = f"Did you mean {matches[0]}?" if matches else f"Known keys: {', '.join(sorted(self._known))}."
                refuse(self.key(str(name)), self.values[name], "is not a known key", hint)

    def _take(self, name: str, default: object) -> object:
        self._known.add(name)
        value = self.values.get(name, default)
        if value is _REQUIRED:
            refuse(self.key(name), None, "is missing", f"Add the key {name}.")
        return value


def _is_finite(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and math.isfinite(value)


def _range(low: float, high: float) -> str:
    if math.isinf(high):
        return f"{low:g} or more"
    if math.isinf(low):
        return f"{high:g} or less"
    return f"{low:g} to {high:g}"


@dataclass(frozen=True, slots=True)
class Login:
    """User name and password; the password appears in no configuration, message or log."""

    user: str
    password: str = field(repr=False)


def read_login(options: Options) -> Login | None:
    """Take `user` with `password_file` (its first line) or `password_env` (an environment variable)."""
    if "user" not in options:
        return None
    user = options.text("user")
    if "password_env" in options:
        name = options.text("password_env")
        if name not in os.environ:
            refuse(options.key("password_env"), name, "is not in the environment", "Set the variable, or correct it.")
        return Login(user, os.environ[name])
    if "password_file" not in options:
        return Login(user, "")
    file = Path(options.text("password_file"))
    try:
        return Login(user, (file.read_text(encoding="utf-8").splitlines() or [""])[0])
    except (OSError, ValueError) as error:
        refuse(options.key("password_file"), str(file), f"cannot be read: {error}", "Give a readable text file.")


def read_tls(options: Options) -> ssl.SSLContext:
    """Take `ca_file`, `cert_file` and `key_file`: certificate authority of the server, our certificate and our key.

    Only certificates of a given `ca_file` are trusted; without it, the system's authorities.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT) if "ca_file" in options else ssl.create_default_context()
    _load(options, "ca_file", lambda file: context.load_verify_locations(cafile=file))
    key = options.text("key_file") if "key_file" in options else None
    _load(options, "cert_file", lambda file: context.load_cert_chain(file, key))
    return context


def _load(options: Options, key: str, load: Callable[[str], None]) -> None:
    if key not in options:
        return
    file = options.text(key)
    try:
        load(file)
    except OSError as error:
        refuse(options.key(key), file, f"cannot be loaded: {error}", "Give the path of a readable PEM file.")


def import_extra(name: str, library: str) -> ModuleType:
    """Import the library of an optional driver.

    Raises
    ------
    ConfigurationError
        The library is not installed; the remedy names the extra that installs it.
    """
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise ConfigurationError(
            f"needs the package {library.partition('.')[0]}, which cannot be imported: {error}",
            field="driver",
            value=name,
            remedy=f'Install it: pip install "relay-autotuner[{name}]".',
        ) from error


def check_names(names: Collection[str], allowed: Collection[str], verb: str) -> None:
    """Raise `InputError` for the first signal that this backend cannot read or write; `verb` is "read" or "write"."""
    for name in names:
        if name not in allowed:
            raise InputError(
                f"is not a signal that this backend can {verb}",
                field="signal",
                value=name,
                remedy=f"Use one of {', '.join(sorted(allowed))}.",
            )


def check_finite(values: Mapping[str, float]) -> None:
    """Raise `DeviceRefusedError` for the first value that is not finite, before anything is written."""
    for name, value in values.items():
        if not math.isfinite(value):
            raise DeviceRefusedError("is not a finite number", field=name, value=value, remedy="Give a finite number.")
