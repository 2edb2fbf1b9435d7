"""Making good what a killed program left behind: the loop is given back before anything new is done with it.

Rules of this file:

1. The output goes back through `Restorer`, as at every other end; over a dead link it is tried until its limit.
2. What the device holds is read first. In auto, or at an output that the interrupted tuning never commanded, somebody
   has taken the loop over since: nothing is written.
3. A journal is marked as ended only when the loop has been given back.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.safety import Supervisor
from autotuner.core.settings import ExperimentSettings
from autotuner.core.tuning import wish_from
from autotuner.core.verdict import aborted, failed
from autotuner.errors import InputError, LinkError
from autotuner.ports import AUTO, OUTPUT
from autotuner.runtime.events import SampleTaken
from autotuner.runtime.journal_file import INTERRUPTED
from autotuner.runtime.patient import Patient
from autotuner.runtime.restore import READ_BACK_SHARE, Restorer, persistently
from autotuner.runtime.ticker import Ticker
from autotuner.runtime.tuning import Tuning, TuningRequest

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.configuration import LoopTable
    from autotuner.core.verdict import Verdict
    from autotuner.ports import Backend
    from autotuner.runtime.events import Event
    from autotuner.runtime.journal import Journal
    from autotuner.runtime.journal_file import Kept

START_AGAIN = "Start it again when wanted."

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Recovery:
    """The way back of one interrupted tuning.

    Attributes
    ----------
    kept : Kept
        Its journal.
    loop : LoopTable
        Its loop.
    backend : Backend
        The device.
    publish : callable
        Takes events.
    limit_s : float
        Longest time to keep trying, s.
    """

    kept: Kept
    loop: LoopTable
    backend: Backend
    publish: Callable[[Event], None]
    limit_s: float

    async def run(self) -> Verdict:
        """Give the loop back; the verdict's code is `interrupted` when that is done, `output_unknown` otherwise."""
        before, target = self.kept.before, self.kept.target
        if before is None or target is None or self.kept.restored:
            return _interrupted("nothing of the loop had to be restored")
        device, ticker = Patient(self.backend), Ticker(self.loop.sample_time_s)

        async def look() -> dict[str, float]:
            await device.open()
            return await device.read([name for name in (OUTPUT, AUTO) if name in device.readable])

        try:
            seen = await persistently(look, ticker, self.publish, self.limit_s)
            if seen is None:
                return _unknown(target)
            if taken := self._taken_over(seen):
                return _interrupted(taken)
            done = await self._restorer(device, ticker).restore(before, target, seen.get(OUTPUT, math.nan))
        finally:
            await persistently(device.close, ticker, lambda _: None, 0.0)
        return _interrupted(f"the output is back at {target:g}") if done else _unknown(target)

    def _taken_over(self, seen: dict[str, float]) -> str | None:
        """Return how it shows that somebody drives the loop since, or None."""
        if seen.get(AUTO):
            return "the device's own controller drives the output: nothing was written"
        held = seen.get(OUTPUT)
        if held is None or self._commanded(held):
            return None
        return f"the output stood at {held:g}, where the tuning had never put it: it was left there"

    def _commanded(self, held: float) -> bool:
        """Return whether the tuning may have left the output there: at a command, or on a slew-limited way."""
        commanded, tolerance = self.kept.commanded, self._tolerance
        if self.loop.limits.output_slew_per_s is not None or math.isnan(held):
            return not (held < min(commanded) - tolerance or held > max(commanded) + tolerance)
        return any(abs(held - output) <= tolerance for output in commanded)

    @property
    def _tolerance(self) -> float:
        low, high = self.loop.limits.output
        return READ_BACK_SHARE * (high - low)

    def _restorer(self, device: Backend, ticker: Ticker) -> Restorer:
        supervisor = Supervisor(self.loop.experiment_settings().limits, self.loop.safety_settings())
        return Restorer(device, supervisor, ticker, self.publish, self.limit_s, self._tolerance)


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
    verdict = (
        _unknown(kept.target) if kept.target is not None else _interrupted("nothing of the loop had to be restored")
    )
    try:
        verdict = await Recovery(kept, loop, backend, tuning.publish, limit_s).run()
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
        return _interrupted("nothing of the loop had to be restored")
    return failed(
        "output_unknown",
        f"the program was killed during the tuning of loop {kept.loop}, and that device is not configured any more: "
        f"its output could not be restored",
        f"Put the device's table back as it was, or set output {kept.target:g} by hand and delete {kept.path}.",
    )


def _interrupted(what: str) -> Verdict:
    return aborted(INTERRUPTED, f"the program was killed during the tuning; {what}", START_AGAIN)


def _unknown(target: float) -> Verdict:
    return failed(
        "output_unknown",
        f"the program was killed during the tuning, and the output could not be brought back to {target:g}: "
        f"what it is now is unknown",
        "Check the link: it is tried again with the next start. Or set the output on the device by hand.",
    )
