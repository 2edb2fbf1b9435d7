"""Live progress of a tuning: lines on a terminal, nothing in a pipe."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console

from autotuner.runtime.events import (
    EstimateUpdated,
    LinkTrouble,
    OutputRestored,
    OutputUnknown,
    PhaseChanged,
    SampleTaken,
)

if TYPE_CHECKING:
    from autotuner.configuration import LoopTable
    from autotuner.runtime.events import Event
    from autotuner.runtime.tuning import Tuning

PHASES = {
    "arm": "looking at the loop",
    "quiet": "holding the output, measuring noise and drift",
    "approach": "moving off the output's limit",
    "relay": "oscillating under the relay",
    "check": "smaller moves, to judge the model on what was not fitted",
    "restore": "giving the loop back",
    "ended": "the loop is back as it was found",
}


async def show_progress(tuning: Tuning, loop: LoopTable) -> None:
    """Print what happens until the tuning has ended; only when standard error is a terminal."""
    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        return
    with console.status("") as status:
        async for event in tuning.follow():
            if isinstance(event, SampleTaken):
                pv, output = f"PV {event.pv:.5g} {loop.pv_unit}", f"output {event.output:.5g} {loop.output_unit}"
                status.update(f"{event.t:8.1f} s   {pv}   {output}")
            elif text := describe(event):
                console.print(f"[dim]{event.t:8.1f} s[/dim]  {text}")


def describe(event: Event) -> str | None:
    """Return one line about an event, or None for those that are not worth one."""
    match event:
        case PhaseChanged(phase=phase):
            return f"[bold]{phase}[/bold]: {PHASES.get(phase, '')}"
        case EstimateUpdated():
            return (
                f"half period {event.half_period:2d}: Pu {event.period_s:.4g} s, A {event.peak:.4g}, "
                f"Ku {event.ultimate_gain:.4g}"
            )
        case LinkTrouble(message=message):
            return f"[yellow]link: {message}[/yellow]"
        case OutputUnknown(attempts=attempts, message=message):
            return f"[red]output unknown[/red] (attempt {attempts}): {message}"
        case OutputRestored(output=output, verified=verified):
            return f"output back at {output:.5g}" + (", confirmed by read-back" if verified else "")
        case _:
            return None
