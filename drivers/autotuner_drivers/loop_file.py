"""A loop of a configuration file, as far as a driver is concerned; the tuner checks the rest."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Final

from autotuner.errors import ConfigurationError
from autotuner_drivers.options import Options

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from autotuner.ports import Backend, BackendFactory

OUTPUT_LIMITS: Final = (0.0, 100.0)
ANY_PV: Final = (-math.inf, math.inf)


@dataclass(frozen=True, slots=True)
class Loop:
    """A loop's device.

    Attributes
    ----------
    name, driver : str
        The loop's name and its driver's.
    device : mapping
        The driver's options.
    output, pv : tuple of float
        Limits of the output and of the PV; the PV's are infinite when they are not given.
    """

    name: str
    driver: str
    device: Mapping[str, object]
    output: tuple[float, float] = OUTPUT_LIMITS
    pv: tuple[float, float] = ANY_PV

    def create(self) -> Backend:
        """Return a closed backend; raise `ConfigurationError` naming the key, the value and the remedy."""
        return driver_named(self.driver)(self.device)


def driver_named(name: str) -> BackendFactory:
    """Return the factory of an installed driver."""
    found = {point.name: point for point in entry_points(group="autotuner.drivers")}
    if name not in found:
        raise ConfigurationError(
            "is not an installed driver", field="driver", value=name, remedy=f"Use one of {', '.join(sorted(found))}."
        )
    factory: BackendFactory = found[name].load()
    return factory


def read_loop(file: Path, name: str | None) -> Loop:
    """Read a loop of a TOML file.

    Parameters
    ----------
    file : Path
        The file.
    name : str, optional
        The loop's name; may be left out when the file has one loop only.

    Raises
    ------
    ConfigurationError
        The file cannot be read, or has no such loop, or a key is wrong.
    """
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"cannot be used: {error}", field=str(file), remedy="Give a TOML file.") from error
    loops = Options(values).table("loops", {})
    chosen = name or (next(iter(loops), None) if len(list(loops)) == 1 else None)
    if chosen is None or chosen not in loops:
        raise ConfigurationError(
            f"is not a loop of {file}", field="loop", value=name, remedy=f"Use one of {', '.join(loops)}."
        )
    loop = loops.table(chosen)
    limits = loop.table("limits", {})
    return Loop(
        chosen,
        loop.text("driver"),
        loop.table("device", {}).values,
        limits.span("output", OUTPUT_LIMITS),
        limits.span("pv", ANY_PV),
    )
