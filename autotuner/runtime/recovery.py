"""Making good what a killed program left behind: the loop is given back before anything new is done with it.

Rule of this file: a journal is marked as ended only when the loop has been given back.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from autotuner.core.settings import ExperimentSettings
from autotuner.core.tuning import wish_from
from autotuner.core.verdict import aborted, failed
from autotuner.errors import InputError, LinkError
from autotuner.runtime.events import SampleTaken
from autotuner.runtime.journal_file import INTERRUPTED
from autotuner.runtime.tuning import Tuning, TuningRequest
from autotuner.runtime.way_back import NOTHING, UNKNOWN, WayBack

if TYPE_CHECKING:
    from autotuner.configuration import LoopTable
    from autotuner.core.verdict import Verdict
    from autotuner.ports import Backend
    from autotuner.runtime.events import Event
    from autotuner.runtime.journal import Journal
    from autotuner.runtime.journal_file import Kept

START_AGAIN = "Start it again when wanted."

_log = logging.getLogger(__name__)


def earlier_tuning(kept: Kept, loop: LoopTable | None) -> Tuning:
    """Return a tuning that an earlier program began, with all that its journal tells."""
    try:
        asked = kept.request
        request = TuningRequest(kept.settings, asked["structure"], wish_from(asked), asked["actor"])
    except (InputError, KeyError, TypeError):  # of another version: what it was asked for is lost, its record is not
        request = TuningRequest(loop.experiment_settings() if loop else ExperimentSettings())
    events: list[Event] = [SampleTaken.of(sample) for sample in kept.samples]
    return Tuning(kept.tuning, kept.loop, request, kept=kept, started_at=kept.started_at, events=events)


async def recover(tuning: Tuning, kept: Kept, loop: LoopTable, backend: Backend, limit_s: float) -> Verdict:
    """Give the loop of an interrupted tuning back, and end the tuning and its journal."""
    verdict = _interrupted(NOTHING) if kept.target is None else _unknown(UNKNOWN.format(kept.target))
    try:
        back = await WayBack(kept, loop, backend, tuning.publish, limit_s).go()
        verdict = _interrupted(back.what) if back.done else _unknown(back.what)
    except Exception:  # noqa: BLE001 - whatever it was, the tuning ends with a verdict and the next start tries again
        _log.exception("the loop %s could not be given back", kept.loop)
    finally:
        if tuning.journal is not None:
            await tuning.journal.end(verdict if verdict.code == INTERRUPTED else None)
        tuning.end(verdict)
    return verdict


async def recover_first(name: str, loop: LoopTable, backend: Backend, journal: Journal) -> list[Verdict]:
    """Give a loop back before a tuning of it; return how each of the interrupted tunings ended.

    Raises
    ------
    LoopBusyError
        It was not interrupted: its tuning runs in another program.
    LinkError
        The loop could not be given back, so nothing new may be done with it.
    """
    verdicts = []
    for kept in journal.interrupted(name):
        if kept.device != loop.device_key:
            verdicts.append(unreachable(kept))
            continue
        tuning = earlier_tuning(kept, loop)
        tuning.journal = journal.resume(kept)
        verdict = await recover(tuning, kept, loop, backend, loop.restore_limit_s)
        if verdict.code != INTERRUPTED:
            raise LinkError(verdict.message, remedy=verdict.remedy)
        verdicts.append(verdict)
    return verdicts


def unreachable(kept: Kept) -> Verdict:
    """Return the verdict of a tuning whose loop or device the configuration does not know any more."""
    if kept.target is None or kept.restored:
        return _interrupted(NOTHING)
    return failed(
        "output_unknown",
        f"the program was killed during the tuning of loop {kept.loop}, and that device is not configured any more: "
        f"its output could not be restored",
        f"Put the device's table back as it was, or set output {kept.target:g} by hand and delete {kept.path}.",
    )


def _interrupted(what: str) -> Verdict:
    return aborted(INTERRUPTED, f"the program was killed during the tuning; {what}", START_AGAIN)


def _unknown(what: str) -> Verdict:
    return failed(
        "output_unknown",
        f"the program was killed during the tuning, and {what}",
        "Check the link: it is tried again with the next start. Or set the output on the device by hand.",
    )
