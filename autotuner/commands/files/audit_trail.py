"""Audit trail of the shell: actions of commands, in the data directory that the service uses.

Invariants:

1. Recording only: a failure to write is a line on standard error, never the end of a command.
2. A refused action has no effect and is not recorded, as in `autotuner.service.security.audit`; a failed one may have
   had an effect.
3. The actor is the user by the operating system's account, not by an environment variable.
"""

from __future__ import annotations

import contextlib
import getpass
import os
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.commands.terminal.output import say
from autotuner.commands.terminal.stopping import StoppedError
from autotuner.errors import AutotunerError, StorageError
from autotuner.service.archive.archive_record import BEGUN, DONE, FAILED, STOPPED, WITHOUT_EFFECT, Deed

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from autotuner.application.recovery import Earlier
    from autotuner.application.tuning_run import TuningRun
    from autotuner.configuration import ServiceTable
    from autotuner.control.records.lease_record import LeaseRecord
    from autotuner.service.archive.storage.database import Database


def shell_actor() -> str:
    """Return the actor of the shell: `shell:` and the user name."""
    return f"shell:{_user()}"


def _user() -> str:
    try:
        import pwd  # noqa: PLC0415 - not on Windows
    except ImportError:
        return getpass.getuser()
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # in a container a number may have no name
        return str(os.getuid())


@contextlib.contextmanager
def audited(
    service: ServiceTable, action: str, loop: str | None = None, tuning_id: str | None = None
) -> Iterator[None]:
    """Record the action of the block in the audit."""
    status = FAILED
    try:
        yield
        status = DONE
    except StoppedError:
        status = STOPPED
        raise
    except AutotunerError as error:
        from autotuner.service.problems import row_of  # noqa: PLC0415 - brings FastAPI with it

        status = row_of(error).status
        raise
    finally:
        if status not in WITHOUT_EFFECT:
            note(service, action, status, loop, tuning_id)


def note_begun(service: ServiceTable, action: str, loop: str, tuning_id: str) -> None:
    """Append an action that has begun to the audit of a data directory."""
    note(service, action, BEGUN, loop, tuning_id)


def note(
    service: ServiceTable, action: str, status: int, loop: str | None = None, tuning_id: str | None = None
) -> None:
    """Append to the audit of a data directory."""
    from autotuner.control.clock.ticker import utc_now  # noqa: PLC0415 - keeps `--help` quick

    deed = Deed(utc_now(), shell_actor(), action, status, loop, tuning_id)
    _in_store(service, lambda database: database.note(deed), f"not in the audit: {action}")


def keep(service: ServiceTable, tuning: TuningRun) -> None:
    """Store a tuning that has ended in the archive of the service."""
    from autotuner.service.archive.archiver import Archiver  # noqa: PLC0415

    if not tuning.ended:  # it was refused before it began
        return

    def write(database: Database) -> None:
        archiver = Archiver(tuning)
        archiver.go_on(database.begin(archiver.head))
        if (news := archiver.news()) is not None:
            database.write([news])

    _in_store(service, write, f"tuning {tuning.id} is not in the history")


def report_earlier(service: ServiceTable, kept: LeaseRecord, shown: Earlier) -> None:
    """Report the interrupted run of a loop and its recovery; its changes go into the history."""
    from autotuner.application.recovery import EarlierVerification  # noqa: PLC0415 - keeps `--help` quick

    assert shown.verdict is not None  # noqa: S101 - it has ended
    say(f"earlier {kept.kind} of {kept.loop}: {shown.verdict.message}")
    note(service, f"{kept.kind} recovered {kept.after}", DONE, kept.loop, kept.tuning)
    if isinstance(shown, EarlierVerification):
        keep(service, shown.tuning)


def _in_store(service: ServiceTable, work: Callable[[Database], None], otherwise: str) -> None:
    from autotuner.service.archive.storage.database import Database  # noqa: PLC0415
    from autotuner.service.archive.storage.database_address import address_of  # noqa: PLC0415 - keeps `--help` quick

    folder = Path(service.data_directory)
    try:
        _make(folder)
        database = Database(address_of(folder, service.database_url))
        try:
            work(database)
        finally:
            database.close()
    except AutotunerError as error:
        say(f"{otherwise}: {error}")


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(
            f"cannot be made: {error.strerror}", field=str(folder), remedy="Set service.data_directory."
        ) from error
