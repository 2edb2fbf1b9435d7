"""A change of gains without a verification, recorded on disk while it is pending.

    unproved (on disk) -> ledger, first gain .. last gain, read back -> proved,   or the previous gains -> ended

Invariants:

1. Gains that are unproved in the journal and applied in the ledger are replaced by the previous ones at the next start,
   or earlier by the loop process: a device never keeps some gains of one controller and some of another.
2. The journal of a change ends with it, unless the gains in the device are unknown.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.control.devices.retrying import to_its_end
from autotuner.core.verdict import Outcome, Verdict, failed
from autotuner.errors import AutotunerError, StorageError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping

    from autotuner.control.records.gains_ledger import GainsLedger
    from autotuner.control.records.open_journal import OpenJournal

BACK = "the old gains are restored"
SETTLED = Verdict(Outcome.DONE, "settled", "the gains in the device are known")


@dataclass(frozen=True, slots=True)
class Unproved:
    """A change of gains that was pending when its program was killed.

    Attributes
    ----------
    change : str
        When it began, as the ledger has it.
    found : mapping of str to float
        Number of each signal before the first write.
    """

    change: str
    found: Mapping[str, float]


@dataclass(slots=True)
class PendingGains:
    """One change of a device's gains, from its first write until the gains in the device are known.

    Attributes
    ----------
    journal : OpenJournal
        Its journal.
    change : str or None
        The change of the ledger, by its start time; None before any write, and once the
        was written has been read back.
    failure : Verdict or None
        Why it broke off.
    """

    journal: OpenJournal
    change: str | None = None
    failure: Verdict | None = None

    async def begins(self, change: str, found: Mapping[str, float]) -> None:
        """Record the change and the gains found on disk; raise `StorageError` on failure."""
        await self.journal.changing(change, found)
        self.change = change

    async def done(self) -> None:
        """Record that all gains were read back."""
        self.change = None
        await self.journal.proved()

    async def end(self, ledger: GainsLedger, *, alone: bool = False) -> None:
        """Close the journal; it has no end where old gains may still have to go back, or `alone` to report it."""
        unsettled = await self._is_unsettled(ledger)
        if alone and self.change is not None and not unsettled:
            await self.journal.released(BACK)
            await self.journal.end(None)
            return
        await self.journal.end(self.failure if unsettled else SETTLED, released=not unsettled)

    async def _is_unsettled(self, ledger: GainsLedger) -> bool:
        if self.change is None:
            return False
        try:
            latest = await ledger.latest()
        except StorageError:
            return True
        return latest is not None and latest.at == self.change


@contextlib.asynccontextmanager
async def under_way(
    journal: OpenJournal | None, ledger: GainsLedger, alone: Callable[[], bool] = lambda: False
) -> AsyncIterator[PendingGains | None]:
    """Record in a journal the changes of gains in the block; `alone`: the front is gone."""
    if journal is None:
        yield None
        return
    change = PendingGains(journal)
    try:
        yield change
    except AutotunerError as error:
        change.failure = failed("not_applied", error.message, error.remedy)
        raise
    finally:
        await to_its_end(change.end(ledger, alone=alone()))
