"""Results for people: tables and a picture in the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from autotuner.commands.chart import chart

if TYPE_CHECKING:
    from pathlib import Path

    from autotuner.configuration import LoopTable
    from autotuner.core.identification import Identification
    from autotuner.core.tuning import Tuning as Gains
    from autotuner.core.verdict import Verdict
    from autotuner.runtime.tuning import Tuning

COLOURS = {"done": "green", "refused": "yellow", "aborted": "yellow", "failed": "red"}


def show_tuning(tuning: Tuning, loop: LoopTable, picture: Path | None) -> None:
    """Print what a tuning found: picture, model, gains, verdict."""
    console = Console(highlight=False)
    if tuning.analysis is not None:
        show_identification(console, tuning.analysis.identification)
        if tuning.analysis.gains is not None:
            show_gains(console, tuning.analysis.gains)
    samples = tuning.controller.samples if tuning.controller is not None else []
    if len(samples) > 1:
        console.print(chart(tuning.recording(), loop.pv_unit, loop.output_unit, console.width), markup=False)
    for warning in tuning.warnings:
        console.print(f"[yellow]warning:[/yellow] {warning}")
    if picture is not None and picture.exists():
        console.print(f"picture: {picture}")
    if tuning.verdict is not None:
        show_verdict(console, tuning.verdict)


def show_verdict(console: Console, verdict: Verdict) -> None:
    """Print how it ended, and what to do next."""
    outcome = verdict.outcome.value
    console.print(f"[{COLOURS[outcome]} bold]{outcome}[/]: {verdict.message}")
    if verdict.remedy:
        console.print(f"  {verdict.remedy}")


def show_identification(console: Console, identification: Identification) -> None:
    """Print every estimate side by side, the recommended one marked, each parameter with its standard error."""
    table = Table(title="Process model", title_justify="left")
    for title in ("estimate", "structure", "parameters +- standard error", "fit"):
        table.add_column(title)
    for name, estimate in identification.estimates.items():
        mark = " *" if name == identification.recommended else ""
        if estimate.model is None:
            table.add_row(name, "", f"[dim]{estimate.refusal or 'does not apply'}[/dim]", "")
            continue
        errors = estimate.standard_error
        parameters = "   ".join(
            f"{key} {value:.5g}" + (f" +- {errors[key]:.2g}" if key in errors else "")
            for key, value in estimate.model.parameters().items()
        )
        table.add_row(name + mark, estimate.model.structure, parameters, f"{estimate.fit_percent:.2f} %")
    console.print(table)
    cycle = identification.limit_cycle
    if cycle is not None:
        console.print(f"limit cycle: Pu {cycle.Pu:.5g} s, A {cycle.A:.4g}, A1 {cycle.A1:.4g}, Ku {cycle.Ku:.4g}")


def show_gains(console: Console, gains: Gains) -> None:
    """Print the recommended gains, and what the rules would have given, with their margins."""
    table = Table(title="Gains (ideal form)", title_justify="left")
    for title in ("", "Kp", "Ti s", "Td s", "Tf s", "b", "Ms", "phase margin", "gain margin"):
        table.add_column(title, justify="left" if not title else "right")
    best = gains.gains
    rows = [(f"[bold]{gains.goal or gains.rule}[/bold]", best, gains.margins)]
    rows += [(candidate.title, candidate.gains, candidate.margins) for candidate in gains.alternatives]
    for title, g, m in rows:
        robustness = (f"{m.Ms:.2f}", f"{m.phase_margin_deg:.0f} deg", f"{m.gain_margin:.2f}") if m else ("", "", "")
        table.add_row(title, f"{g.Kp:.4g}", f"{g.Ti:.4g}", f"{g.Td:.4g}", f"{g.Tf:.3g}", f"{g.b:.2g}", *robustness)
    console.print(table)
