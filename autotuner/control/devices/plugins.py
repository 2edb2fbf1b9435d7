"""Drivers and further commands, found by entry point.

A package announces a driver under `autotuner.drivers` and a command under `autotuner.commands`. Nothing here knows
one by name, so an outside driver is exactly as good as one that comes with the tuner.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Protocol

from autotuner.errors import ConfigurationError
from autotuner.ports import Backend

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

DRIVERS = "autotuner.drivers"
COMMANDS = "autotuner.commands"


class Command(Protocol):
    """A command of the shell interface."""

    @property
    def help(self) -> str:
        """One-line summary for the list of commands."""

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the command's arguments."""

    def run(self, args: argparse.Namespace) -> int:
        """Do it and return the exit code: 0 done, 1 failed with a reason, 2 wrong usage."""


def announced(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name."""
    return {point.name: point for point in entry_points(group=group)}


def make_backend(driver: str, options: Mapping[str, object], field: str) -> Backend:
    """Make a closed backend.

    Parameters
    ----------
    driver : str
        Name of the entry point.
    options : mapping
        The loop's `device` table, verbatim.
    field : str
        Dotted key of that loop, for messages.

    Raises
    ------
    ConfigurationError
        Unknown driver, a driver that cannot be loaded, or options that it refuses.
    """
    drivers = announced(DRIVERS)
    if driver not in drivers:
        raise ConfigurationError(
            "is not an installed driver",
            field=f"{field}.driver",
            value=driver,
            remedy=f"Use one of {', '.join(sorted(drivers))}, or install the package that announces it.",
        )
    try:
        factory = drivers[driver].load()
    except ImportError as error:
        raise ConfigurationError(
            f"cannot be loaded: {error}", field=f"{field}.driver", value=driver, remedy="Install its dependencies."
        ) from error
    try:
        backend = factory(options)
    except ConfigurationError as error:
        raise ConfigurationError(
            error.message, field=f"{field}.device.{error.field}", value=error.value, remedy=error.remedy
        ) from error
    if not isinstance(backend, Backend):
        raise ConfigurationError(
            "does not make a backend",
            field=f"{field}.driver",
            value=driver,
            remedy="Correct the driver (see ports.py).",
        )
    return backend


def is_simulated(backend: Backend) -> bool:
    """Return whether a backend has no hardware: it may run in virtual time, and nothing of it outlives the program."""
    return bool(getattr(backend, "simulated", False))
