"""Physics that another package adds to the diagnosis, found by entry point.

A package announces an `EffectPlugin` under the group `autotuner.effects`. Its effects are searched together with those
of the catalogue, reported with the plug-in's advice, simulated in the closed loop by its element, and seen by a
controller as its view describes. No plug-in is known by name here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from autotuner.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.process import ProcessModel

GROUP = "autotuner.effects"


@dataclass(frozen=True, slots=True)
class EffectPlugin:
    """One physics, in one or more forms.

    Attributes
    ----------
    name : str
        What is reported; every form that `make` returns has it.
    make : callable
        From the record that is searched and the process alone, the forms, with starts taken from them.
    advice : str
        Advice; may contain the sizes as format fields, such as ``{share:.2g}``.
    element : callable, optional
        From the sizes, the element between controller and process: a new function of the output as deviation from rest,
        called once in each sample, that returns 0 at rest.
    controller_view : callable, optional
        From the process without the effect and the sizes, the process that a controller sees; None where no model
        represents it, and then no gains are designed.
    """

    name: str
    make: Callable[[Dataset, Fitted], Sequence[Effect]]
    advice: str
    element: Callable[[Mapping[str, float]], Callable[[float], float]] | None = None
    controller_view: Callable[[ProcessModel, Mapping[str, float]], ProcessModel | None] | None = None


@lru_cache(maxsize=1)
def installed_effects() -> Mapping[str, EffectPlugin]:
    """Return the plug-ins of all installed packages by name.

    Raises
    ------
    ConfigurationError
        One that cannot be loaded, or is no `EffectPlugin`.
    """
    found = {}
    for point in entry_points(group=GROUP):
        field = f"{GROUP}.{point.name}"
        try:
            plugin = point.load()
        except Exception as error:
            raise ConfigurationError(
                f"cannot be loaded: {error!r}", field=field, remedy=f"Repair or uninstall the package of {point.value}."
            ) from error
        if not isinstance(plugin, EffectPlugin):
            raise ConfigurationError(
                "is not an EffectPlugin", field=field, value=type(plugin).__name__, remedy="Announce an EffectPlugin."
            )
        found[plugin.name] = plugin
    return found
