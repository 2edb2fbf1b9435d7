"""Live progress of a tuning and of its verification: lines on a terminal, nothing in a pipe.

Invariant: a half period is one line, printed when it and its model are known.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from autotuner.control.reporting.events import (
    EstimateUpdated,
    LinkTrouble,
    LoopObserved,
    ModelUpdated,
    OutputRestored,
    OutputUnknown,
    PhaseChanged,
    ReleaseBump,
    SampleTaken,
)
from autotuner.control.reporting.link_log import Troubles
from autotuner.control.verification.verification_events import (
    GainsWritten,
    StepMade,
    VerificationEnded,
    VerificationPhaseChanged,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.status import Status

    from autotuner.application.tuning_run import TuningRun
    from autotuner.configuration import LoopTable
    from autotuner.control.reporting.events import Event
    from autotuner.control.verification.verification_events import VerificationEvent
    from autotuner.control.verification.verification_run import VerificationRun

PHASES = {
    "arm": "reading the loop",
    "quiet": "holding the output, measuring noise and drift",
    "approach": "moving off the output's limit",
    "relay": "oscillating under the relay",
    "check": "smaller moves, to validate the model on data that were not fitted",
    "restore": "releasing the loop",
    "ended": "the loop is as it was found",
}
STAMP = 12
"""Columns of the time before a line."""


class Progress:
    """Formats events as lines, one for each half period: its estimate, and the best model so far.

    Parameters
    ----------
    width : int
        Columns of the terminal; numbers that do not fit on a line are omitted.
    """

    def __init__(self, width: int) -> None:
        self._width = width - STAMP
        self._troubles = Troubles()
        self._estimate: EstimateUpdated | None = None
        self._model: ModelUpdated | None = None

    def take(self, event: Event) -> Iterator[tuple[float, str]]:
        """Yield the lines that are complete after an event, each with its time, s."""
        if isinstance(event, ModelUpdated):
            self._model = event
            return
        if isinstance(event, EstimateUpdated | PhaseChanged) and self._estimate is not None:
            yield self._estimate.t, self._half_period(self._estimate)
            self._estimate = None
        if isinstance(event, EstimateUpdated):
            self._estimate = event
        for reported in self._troubles.take(event):
            if text := describe(reported):
                yield reported.t, text

    def _half_period(self, estimate: EstimateUpdated) -> str:
        line = f"half period {estimate.half_period:2d}"
        items = [f"Pu {estimate.period_s:.4g} s"]
        if math.isfinite(estimate.ultimate_gain):
            items.append(f"Ku {estimate.ultimate_gain:.4g}")
        if (model := self._model) is not None:
            items += [f"{model.structure} +-{100.0 * model.relative_error:.2g} %"]
            items += [f"{name} {value:.4g}" for name, value in model.parameters.items()]
        for item in items:
            if len(line) + len(item) + 2 > self._width:
                break
            line += f"  {item}"
        return line


async def show_progress(tuning: TuningRun, loop: LoopTable) -> None:
    """Print the progress until the tuning has ended; only when standard error is a terminal."""
    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        return
    progress = Progress(console.width)
    with console.status("") as status:
        async for event in tuning.follow():
            if isinstance(event, SampleTaken | LoopObserved):
                _show_sample(status, loop, event.t, event.pv, event.output)
            for t, text in progress.take(event):
                _print(console, t, text)


async def show_verification(run: VerificationRun, loop: LoopTable) -> None:
    """Print the progress until the verification has ended; only when standard error is a terminal."""
    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        return
    with console.status("") as status:
        async for event in run.follow():
            if isinstance(event, SampleTaken):
                _show_sample(status, loop, event.t, event.pv, event.output)
            elif text := describe_verification(event, loop):
                _print(console, event.t, text)


def _show_sample(status: Status, loop: LoopTable, t: float, pv: float, output: float) -> None:
    status.update(f"{t:8.1f} s   PV {pv:.5g} {loop.pv_unit}   output {output:.5g} {loop.output_unit}")


def _print(console: Console, t: float, text: str) -> None:
    console.print(Text.assemble((f"{t:8.1f} s  ", "dim"), Text.from_markup(text)), soft_wrap=True)


def describe(event: Event) -> str | None:
    """Return one line about an event, or None for events that are not shown."""
    match event:
        case PhaseChanged(phase=phase):
            return f"[bold]{phase}[/bold]: {PHASES.get(phase, '')}"
        case LinkTrouble(message=message):
            return f"[yellow]link: {message}[/yellow]"
        case OutputUnknown(attempts=attempts, message=message):
            return f"[red]output unknown[/red] (attempt {attempts}): {message}"
        case OutputRestored(output=output, verified=verified):
            return f"output restored to {output:.5g}" + (", confirmed by read-back" if verified else "")
        case ReleaseBump():
            return f"[yellow]{event}[/yellow]"
    return None


def describe_verification(event: VerificationEvent, loop: LoopTable) -> str | None:
    """Return one line about an event of a verification, or None for events that are not shown."""
    match event:
        case VerificationPhaseChanged(phase=phase, expected_s=expected_s):
            longest = f", up to {expected_s:.4g} s" if math.isfinite(expected_s) else ""
            return f"[bold]verification: {phase}[/bold]{longest}"
        case GainsWritten(written=written, form=form):
            return f"gains in the device ({form}): " + "  ".join(f"{name} {v:.6g}" for name, v in written.items())
        case StepMade(step=step, set_point=set_point, duration_s=duration_s):
            unit = loop.pv_unit
            return f"set point to {set_point:.5g} {unit}, a step of {step:.4g} {unit}, watched for {duration_s:.4g} s"
        case VerificationEnded(outcome=outcome, message=message):
            return f"[bold]{outcome}[/bold]: {message}"
    return None
