"""List of monitored loops in a file, so that a restarted service continues to monitor them.

Invariants: a file that cannot be written or read ends no request and no start; the log reports it.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from pydantic import BaseModel, TypeAdapter, ValidationError

from autotuner.application.monitor import plan_of
from autotuner.control.records.atomic_file import write_whole
from autotuner.errors import AutotunerError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from pathlib import Path

    from autotuner.application.manager import Manager
    from autotuner.application.tuning_run import TuningRun
    from autotuner.service.archive.archived_tuning import ArchivedTuning

_log = logging.getLogger(__name__)


class Watched(BaseModel, frozen=True):
    """Configuration of a monitor: the tuning whose model gives the expected behaviour, and the window, s."""

    tuning_id: str
    window_s: float


_FORM = TypeAdapter(dict[str, Watched])


class WatchList:
    """The loops that are watched, by name.

    Parameters
    ----------
    path : Path
        The file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> dict[str, Watched]:
        """Return the monitored loops; empty without a readable file."""
        try:
            return _FORM.validate_json(self._path.read_bytes())
        except FileNotFoundError:
            return {}
        except (OSError, ValidationError) as error:
            _log.warning("%s cannot be read, no loop is watched on: %s", self._path, error)
            return {}

    def note(self, loop: str, watched: Watched | None) -> None:
        """Keep that a loop is watched, or not any more."""
        others = {name: kept for name, kept in self.read().items() if name != loop}
        self._write(others if watched is None else {**others, loop: watched})

    def _write(self, loops: dict[str, Watched]) -> None:
        try:
            write_whole(self._path, _FORM.dump_json(loops, indent=1))
        except OSError as error:
            _log.warning("%s cannot be written, a restart will not continue to monitor: %s", self._path, error)


async def watch_on(
    kept: WatchList, manager: Manager, find: Callable[[str], Awaitable[TuningRun | ArchivedTuning]]
) -> None:
    """Watch the loops again that were watched when the service ended; failures are logged, and the entry stays.

    `find` returns a tuning by its id.
    """
    for loop, watched in kept.read().items():
        try:
            sample_time_s = manager.configuration.loop(loop).sample_time_s
            tuning = await find(watched.tuning_id)
            manager.monitors.start(plan_of(tuning.to_dict(), sample_time_s, watched.window_s))
        except AutotunerError as error:
            _log.warning("loop %s is not watched any more: %s", loop, error)
