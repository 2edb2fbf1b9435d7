"""Log lines of a tuning: phases, errors, the final output, and its gains."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from autotuner.control.reporting.events import (
    Ended,
    LinkTrouble,
    OutputRestored,
    OutputUnknown,
    PhaseChanged,
    ReleaseBump,
)
from autotuner.control.reporting.link_log import Troubles

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.control.reporting.events import Event

_log = logging.getLogger(__name__)


def log_event(tuning_id: str, loop: str, event: Event, *, all_clear: bool = False) -> None:
    """Log important events in one line each; samples and estimates are not logged.

    `all_clear` is for an output that was unknown before.
    """
    match event:
        case PhaseChanged(phase=phase):
            level, text = logging.INFO, f"phase {phase}"
        case OutputRestored(output=output, verified=verified):
            level = logging.WARNING if all_clear else logging.INFO
            text = f"output back at {output:g}, {'read back' if verified else 'not read back'}"
            text = f"all clear: {text}" if all_clear else text
        case OutputUnknown(attempts=attempts, message=message):
            level, text = logging.WARNING, f"output unknown after attempt {attempts}: {message}"
        case ReleaseBump():
            level, text = logging.WARNING, str(event)
        case LinkTrouble(message=message):
            level, text = logging.WARNING, message
        case Ended(outcome=outcome, code=code, message=message):
            level, text = logging.INFO, f"{outcome} ({code}): {message}"
        case _:
            return
    about = {"tuning": tuning_id, "loop": loop, "t_s": event.t}
    _log.log(level, "tuning %s of loop %s, %.3f s: %s", tuning_id, loop, event.t, text, extra=about)


@dataclass(slots=True)
class EventLog:
    """Writes the lines of one tuning: as `log_event`, but trouble with its line that repeats itself is counted."""

    troubles: Troubles = field(default_factory=Troubles)
    _alarmed: bool = False

    def take(self, tuning_id: str, loop: str, event: Event) -> None:
        """Log an event that is due; the first restored output after an alarm is logged as an all-clear."""
        for reported in self.troubles.take(event):
            all_clear = self._alarmed and isinstance(reported, OutputRestored)
            self._alarmed = isinstance(reported, OutputUnknown) or (self._alarmed and not all_clear)
            log_event(tuning_id, loop, reported, all_clear=all_clear)


def log_gains(tuning_id: str, loop: str, text: str, values: Mapping[str, float] | None = None) -> None:
    """Write one line about gains of a loop, with their numbers in the device's form where there are any."""
    about = {"loop": loop} | ({"tuning": tuning_id} if tuning_id else {})
    numbers = "".join(f", {name} {value:.6g}" for name, value in (values or {}).items())
    subject = f"tuning {tuning_id} of loop {loop}" if tuning_id else f"loop {loop}"
    _log.info("%s: %s%s", subject, text, numbers, extra=about)
