"""Results for people: tables and a picture in the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from autotuner.commands.chart import chart

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping
    from pathlib import Path

    from autotuner.configuration import LoopTable
    from autotuner.core.identification import Identification
    from autotuner.core.recording import Recording
    from autotuner.core.tuning import Margins, PidGains
    from autotuner.core.tuning import Tuning as Gains
    from autotuner.core.verdict import Verdict
    from autotuner.runtime.tuning import Tuning
    from autotuner.runtime.verification_run import VerificationRun

PIPE_WIDTH = 120
"""Columns when the output is no terminal: nobody folds lines there."""
BRIEF = ("ziegler_nichols_pid", "tyreus_luyben_pi", "simc_pi", "lambda_pi", "amigo_pi", "amigo_pid")
"""Rules shown beside the recommended gains of a tuning; `autotuner gains` shows them all."""
COLOURS = {"done": "green", "refused": "yellow", "aborted": "yellow", "failed": "red"}


def results_console() -> Console:
    """Return the console for results, on standard output."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=PIPE_WIDTH)


def show_tuning(tuning: Tuning, loop: LoopTable, picture: Path | None) -> None:
    """Print what a tuning found: picture, model, gains, verdict."""
    console = results_console()
    if tuning.analysis is not None:
        show_identification(console, tuning.analysis.identification)
        if (error := tuning.analysis.error) is not None:
            console.print(
                f"error on the part not fitted: {f'{error.held_out:.3g} {loop.pv_unit}'.rstrip()}, on the fitted part "
                f"{error.fitted:.3g}, noise {error.noise_sigma:.3g}"
            )
        if tuning.analysis.gains is not None:
            show_gains(console, tuning.analysis.gains, BRIEF)
    if len(tuning.samples) > 1:
        show_chart(console, tuning.recording(), loop.pv_unit, loop.output_unit)
    for warning in tuning.warnings:
        console.print(f"[yellow]warning:[/yellow] {warning}")
    _show_in_device(console, tuning)
    if picture is not None and picture.exists():
        console.print(f"picture: {picture}")
    if tuning.verdict is not None:
        show_verdict(console, tuning.verdict)


def show_chart(console: Console, recording: Recording, pv_unit: str = "", output_unit: str = "") -> None:
    """Print PV and output over time as characters."""
    text = Text.from_ansi(chart(recording, pv_unit, output_unit, console.width), no_wrap=True)
    console.print(text, crop=True)


def show_verdict(console: Console, verdict: Verdict) -> None:
    """Print how it ended, and what to do next."""
    outcome = verdict.outcome.value
    console.print(f"[{COLOURS[outcome]} bold]{outcome}[/]: {verdict.message}")
    if verdict.remedy:
        console.print(f"  {verdict.remedy}")


def show_identification(console: Console, identification: Identification) -> None:
    """Print every estimate side by side, the recommended one marked, each parameter with its standard error.

    Where the recording itself was refused there is no table: every estimate would only repeat the verdict.
    """
    if all(estimate.refusal == identification.verdict.message for estimate in identification.estimates.values()):
        return
    table = Table(title="Process model", title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
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
        gain = f"Ku {cycle.Ku:.4g}" if cycle.alone else "beside a controller"
        console.print(f"limit cycle: Pu {cycle.Pu:.5g} s, A {cycle.A:.4g}, A1 {cycle.A1:.4g}, {gain}")


def show_gains(console: Console, gains: Gains, rules: Collection[str] | None = None) -> None:
    """Print the recommended gains, and what other rules (all, or those named) would have given, with their margins."""
    best = gains.gains
    table = Table(title="Gains (ideal form)", title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("", no_wrap=True)
    for title in ("Kp", "Ti s", "Td s", "Ms", "phase", "gain"):
        table.add_column(title, justify="right", no_wrap=True)
    table.add_row(f"[bold]{gains.goal or gains.rule}[/bold]", *_numbers(best, gains.margins), end_section=True)
    for candidate in gains.alternatives:
        if rules is None or candidate.rule in rules:
            table.add_row(candidate.rule, *_numbers(candidate.gains, candidate.margins))
    console.print(table)
    console.print(
        f"[bold]Kp {best.Kp:.5g}, Ti {best.Ti:.5g} s, Td {best.Td:.5g} s[/bold], filter Tf {best.Tf:.4g} s, "
        f"set-point weight b {best.b:.3g}"
    )


def show_device_gains(console: Console, told: Mapping[str, Any], what: str) -> None:
    """Print gains of a device before and now, as `Applied.to_dict` and `RolledBack.to_dict` tell them."""
    console.print(f"[bold]{told['loop']}[/bold]: gains {what}")
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("signal", no_wrap=True)
    for title in ("before", "now"):
        table.add_column(title, justify="right", no_wrap=True)
    before, now = told["old"]["values"], told["now"]["values"]
    for name, value in now.items():
        table.add_row(name, f"{before[name]:.6g}", f"{value:.6g}")
    console.print(table)
    if gains := told["now"].get("gains"):
        Ti = "none" if gains["Ti"] is None else f"{gains['Ti']:.5g} s"
        action = f", {told['action']} acting" if "action" in told else ""
        console.print(f"in the ideal form: Kp {gains['Kp']:.5g}, Ti {Ti}, Td {gains['Td']:.5g} s{action}")
    if told.get("margins"):
        console.print(f"on the model: Ms {told['margins']['Ms']:.2f}")
    for warning in told.get("warnings", ()):
        console.print(f"[yellow]warning:[/yellow] {warning}")


def _show_in_device(console: Console, tuning: Tuning) -> None:
    if tuning.applied is not None:
        show_device_gains(console, tuning.applied.to_dict(), "written and read back")
    if tuning.verification is not None:
        show_verification(console, tuning.verification)


def show_verification(console: Console, run: VerificationRun) -> None:
    """Print what a step under the new gains showed."""
    if run.scenario is not None and run.band is not None and run.overshoot is not None:
        console.print(
            f"step of {run.scenario.set_point_step:.4g}: overshoot {100.0 * run.overshoot:.1f} %, predicted "
            f"{100.0 * run.band.nominal.overshoot:.1f} %"
        )
    if run.verdict is not None:
        back = "; the old gains are back" if run.rolled_back else ""
        colour = "green" if run.passed else "red"
        console.print(f"[{colour}]{run.verdict.code}[/{colour}]: {run.verdict.message}{back}")


def _numbers(gains: PidGains, margins: Margins | None) -> list[str]:
    numbers = [f"{gains.Kp:.4g}", f"{gains.Ti:.4g}", f"{gains.Td:.4g}"]
    if margins is None:
        return numbers
    if not margins.stable:
        return [*numbers, "[red]unstable[/red]"]
    return [*numbers, f"{margins.Ms:.2f}", f"{margins.phase_margin_deg:.0f} deg", f"{margins.gain_margin:.2f}"]
