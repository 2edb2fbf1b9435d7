"""Another configuration for a service that runs: which loops are added, changed, removed, and which wait.

Invariant: a loop that a tuning holds keeps its table, so a running tuning is never touched.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection

    from autotuner.configuration import Configuration


@dataclass(frozen=True, slots=True)
class Reloaded:
    """Differences between two configurations.

    Attributes
    ----------
    added, changed, removed : tuple of str
        Loops.
    held : tuple of str
        Loops that differ but are held by a tuning: they stay as they are until the next reload.
    restart : tuple of str
        Keys of `[service]` that differ: they take effect with the next start.
    """

    added: tuple[str, ...]
    changed: tuple[str, ...]
    removed: tuple[str, ...]
    held: tuple[str, ...]
    restart: tuple[str, ...]

    @property
    def new(self) -> tuple[str, ...]:
        """Loops that get another table."""
        return (*self.added, *self.changed)

    def to_dict(self) -> dict[str, list[str]]:
        """Return JSON-ready values."""
        return {name: list(loops) for name, loops in asdict(self).items()}


def differences(old: Configuration, new: Configuration, holding: Collection[str]) -> Reloaded:
    """Return the differences; `holding` are the loops that tunings hold."""
    differ = {name for name in old.loops.keys() & new.loops.keys() if old.loops[name] != new.loops[name]}
    removed = old.loops.keys() - new.loops.keys()
    keys = type(old.service).model_fields
    return Reloaded(
        added=tuple(sorted(new.loops.keys() - old.loops.keys())),
        changed=tuple(sorted(differ - set(holding))),
        removed=tuple(sorted(removed - set(holding))),
        held=tuple(sorted((differ | removed) & set(holding))),
        restart=tuple(f"service.{key}" for key in keys if getattr(old.service, key) != getattr(new.service, key)),
    )


def merged(old: Configuration, new: Configuration, change: Reloaded) -> Configuration:
    """Return the configuration with the loops of the new one, but for those that are held."""
    held = {name: old.loops[name] for name in change.held}
    return old.model_copy(update={"loops": {**new.loops, **held}})
