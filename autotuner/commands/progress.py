"""Live progress of a tuning: lines on a terminal, nothing in a pipe."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.console import Console

from autotuner.runtime.events import (
    EstimateUpdated,
    LinkTrouble,
    ModelUpdated,
    OutputRestored,
    OutputUnknown,
    PhaseChanged,
    SampleTaken,
)
from autotuner.runtime.troubles import Troubles

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
    troubles = Troubles()
    with console.status("") as status:
        async for event in tuning.follow():
            if isinstance(event, SampleTaken):
                pv, output = f"PV {event.pv:.5g} {loop.pv_unit}", f"output {event.output:.5g} {loop.output_unit}"
                status.update(f"{event.t:8.1f} s   {pv}   {output}")
            for told in troubles.take(event):
                if text := describe(told):
                    console.print(f"[dim]{told.t:8.1f} s[/dim]  {text}")


def describe(event: Event) -> str | None:
    """Return one line about an event, or None for those that are not worth one."""
    text = None
    match event:
        case PhaseChanged(phase=phase):
            text = f"[bold]{phase}[/bold]: {PHASES.get(phase, '')}"
        case EstimateUpdated(half_period=number, period_s=Pu, peak=A, ultimate_gain=Ku):
            gain = f", Ku {Ku:.4g}" if math.isfinite(Ku) else ""
            text = f"half period {number:2d}: Pu {Pu:.4g} s, A {A:.4g}{gain}"
        case ModelUpdated(structure=structure, parameters=parameters, standard_error=errors):
            values = ", ".join(f"{name} {value:.4g} +- {errors[name]:.2g}" for name, value in parameters.items())
            text = f"   {structure}: {values}"
        case LinkTrouble(message=message):
            text = f"[yellow]link: {message}[/yellow]"
        case OutputUnknown(attempts=attempts, message=message):
            text = f"[red]output unknown[/red] (attempt {attempts}): {message}"
        case OutputRestored(output=output, verified=verified):
            text = f"output back at {output:.5g}" + (", confirmed by read-back" if verified else "")
    return text
