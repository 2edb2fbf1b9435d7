"""State of the link to each device: of a tuning at its last sample, of an idle loop at its last poll."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from autotuner.control.devices.device_polling import UNDISTURBED
from autotuner.control.reporting.events import LinkTrouble, OutputRestored, OutputUnknown, SampleTaken
from autotuner.service.schemas.operation import LoopLink

if TYPE_CHECKING:
    from autotuner.application.manager import Manager
    from autotuner.application.tuning_run import TuningRun


def links_of(manager: Manager) -> list[LoopLink]:
    """Return the state of every link; an idle loop is polled for the next call."""
    return [_link(manager, name) for name in manager.configuration.loops]


def _link(manager: Manager, name: str) -> LoopLink:
    if (unknown := manager.left.unknown.get(name)) is not None:
        return LoopLink(loop=name, tuning_id=None, link="down", error=unknown)
    holder = manager.running(name)
    if holder is not None:
        trouble = _trouble(holder)
        return LoopLink(loop=name, tuning_id=holder.id, link=_state(bool(holder.samples), trouble), error=trouble)
    seen = manager.reading(name)
    error = None if seen.error == UNDISTURBED else seen.error
    return LoopLink(loop=name, tuning_id=None, link=_state(seen.at is not None, error), error=error)


def _state(heard: bool, error: str | None) -> Literal["up", "down", "unknown"]:  # noqa: FBT001 - two facts, one state
    if error is not None:
        return "down"
    return "up" if heard else "unknown"


def _trouble(tuning: TuningRun) -> str | None:
    """Return why the last call to the device failed; None when it did not."""
    for event in reversed(tuning.events):
        if isinstance(event, SampleTaken | OutputRestored):
            return None
        if isinstance(event, LinkTrouble | OutputUnknown):
            return event.message
    return None
