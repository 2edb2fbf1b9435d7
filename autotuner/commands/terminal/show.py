"""Results for people: tables and a picture in the terminal."""

from __future__ import annotations

import math
import shlex
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from autotuner.core.design.gains import Action, gains_from_dict
from autotuner.reports.pictures.chart import record_chart
from autotuner.reports.pictures.terminal import text as drawn_as_text

if TYPE_CHECKING:
    import argparse
    from collections.abc import Collection, Mapping, Sequence
    from pathlib import Path

    from autotuner.application.tuning_run import TuningRun
    from autotuner.configuration import LoopTable
    from autotuner.control.verification.verification_run import VerificationRun
    from autotuner.core.design import Margins, PidDesign, PidGains
    from autotuner.core.identification import Identification
    from autotuner.core.identification.held_out import HeldOut
    from autotuner.core.recording import Recording
    from autotuner.core.verdict import Verdict

PIPE_WIDTH = 120
"""Width for output to a file or pipe, columns: lines are not folded there."""
BRIEF = ("ziegler_nichols_pid", "tyreus_luyben_pi", "simc_pi", "lambda_pi", "amigo_pi", "amigo_pid")
"""Rules compared with the recommended gains of a tuning; `autotuner gains` shows all rules."""
GAP = 3
"""Blanks between two items of a line."""
SIMULATED = "shell"
"""Identifier of a tuning of a simulated loop, which ends with its program."""
COLOURS = {"done": "green", "refused": "yellow", "aborted": "yellow", "failed": "red"}


class ResultsConsole(Console):
    """A console that leaves a pipe without a reader to `autotuner.commands.terminal.output`."""

    def on_broken_pipe(self) -> None:
        """Raise the error again: the command decides how it ends."""
        raise BrokenPipeError


def results_console() -> Console:
    """Return the console for results, on standard output."""
    console = ResultsConsole(highlight=False)
    return console if console.is_terminal else ResultsConsole(highlight=False, width=PIPE_WIDTH)


def show_tuning(tuning: TuningRun, loop: LoopTable, args: argparse.Namespace) -> None:
    """Print the results of a tuning: gains, verdict and the next command at the end."""
    console = results_console()
    if len(tuning.samples) > 1:
        show_chart(console, tuning.recording(), loop.pv_unit, loop.output_unit)
    gains = tuning.analysis.gains if tuning.analysis else None
    if tuning.analysis is not None:
        show_identification(console, tuning.analysis.identification)
        _show_error(console, tuning.analysis.error, loop.pv_unit)
    if gains is not None:
        show_gains(console, gains, BRIEF)
    show_messages(console, tuning.warnings, tuning.notes)
    _show_in_device(console, tuning)
    _show_files(console, (args.recording, args.picture, args.report))
    if gains is not None:
        show_chosen(console, gains)
    if tuning.verdict is not None:
        show_verdict(console, tuning.verdict)
    if (command := next_command(tuning, loop, args.config)) is not None:
        console.print(f"next: [bold]{escape(command)}[/bold]", soft_wrap=True)


def _show_files(console: Console, files: Sequence[Path | None]) -> None:
    for file in files:
        if file is not None and file.exists():
            console.print(f"written: {escape(str(file))}", soft_wrap=True)
    console.print()


def _show_error(console: Console, error: HeldOut | None, unit: str) -> None:
    if error is None:
        return
    parts = {"where not fitted": error.held_out, "where fitted": error.fitted, "of the noise": error.noise_sigma}
    show_items(console, "model error", [f"{f'{value:.3g} {unit}'.rstrip()} {where}" for where, value in parts.items()])


def next_command(tuning: TuningRun, loop: LoopTable, config: Path | None) -> str | None:
    """Return the command that most users run after this tuning; None where its verdict has the advice."""
    if not tuning.succeeded or tuning.analysis is None or tuning.analysis.gains is None:
        return None
    name = shlex.quote(tuning.loop) + ("" if config is None else f" --config {shlex.quote(str(config))}")
    if tuning.id == SIMULATED:
        return f"autotuner tune {name} --report report.html"
    if tuning.applied is not None:
        return f"autotuner rollback {name}  (restores the gains before)"
    if tuning.verification is not None:
        return None
    if loop.gains is None:
        return f"autotuner tune {name} --verify  (needs [loops.{tuning.loop}.gains], see docs/gains.md)"
    gains = tuning.analysis.gains.gains
    numbers = [gains.Kp] if math.isinf(gains.Ti) else [gains.Kp, gains.Ti, gains.Td]
    return f"autotuner apply {name} --gains {','.join(f'{number:.6g}' for number in numbers)}"


def show_items(console: Console, title: str, items: Sequence[str]) -> None:
    """Print items after a title; a line breaks between them only, so that a number stays with its unit."""
    line = Text.from_markup(title)
    indent = line.cell_len
    for item in items:
        text = Text.from_markup(item)
        if line.cell_len > indent and line.cell_len + GAP + text.cell_len > console.width:
            console.print(line, soft_wrap=True)
            line = Text(" " * indent)
        line = line + Text(" " * GAP) + text
    console.print(line, soft_wrap=True)


def show_chart(console: Console, recording: Recording, pv_unit: str = "", output_unit: str = "") -> None:
    """Print PV and output over time as characters."""
    text = Text.from_ansi(drawn_as_text(record_chart(recording, pv_unit, output_unit), console.width), no_wrap=True)
    console.print(text, crop=True)


def show_verdict(console: Console, verdict: Verdict) -> None:
    """Print the verdict and the next step."""
    outcome = verdict.outcome.value
    console.print(f"[{COLOURS[outcome]} bold]{outcome}[/]: {verdict.message}")
    if verdict.remedy:
        console.print(f"  {verdict.remedy}")


def show_identification(console: Console, identification: Identification) -> None:
    """Print every estimate side by side, the recommended one marked, each parameter with its standard error.

    Without a usable recording there is no table: every estimate would repeat the verdict.
    """
    if all(estimate.refusal == identification.verdict.message for estimate in identification.estimates.values()):
        return
    console.print("[bold]Process model[/bold] (* recommended; times in s)")
    for name, estimate in identification.estimates.items():
        mark = f"{name} *" if name == identification.recommended else name
        if estimate.model is None:
            console.print(Padding(f"[dim]{mark}: {estimate.refusal or 'does not apply'}[/dim]", (0, 0, 0, 2)))
            continue
        errors = estimate.standard_error
        parameters = [
            f"{key} {value:.5g}" + (f" +- {errors[key]:.2g}" if key in errors else "")
            for key, value in estimate.model.parameters().items()
        ]
        console.print(f"  {mark:<22}{estimate.model.structure}, fit {estimate.fit_percent:.1f} %")
        show_items(console, " ", parameters)
    cycle = identification.limit_cycle
    if cycle is not None:
        gain = f"Ku {cycle.Ku:.4g}" if cycle.alone else "in parallel with a controller"
        show_items(console, "limit cycle", [f"Pu {cycle.Pu:.5g} s", f"A {cycle.A:.4g}", f"A1 {cycle.A1:.4g}", gain])


def show_gains(console: Console, gains: PidDesign, rules: Collection[str] | None = None) -> None:
    """Print the recommended gains and those of other rules (all, or the named ones), with their margins."""
    best = gains.held.gains if gains.held else gains.gains
    table = Table(
        title="Gains (ideal form)", title_justify="left", box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True
    )
    table.add_column("", no_wrap=True)
    for title in ("Kp", "Ti s", "Td s", "Ms", "oversh.", "settles", "output"):
        table.add_column(title, justify="right", no_wrap=True)
    settling_s = gains.predicted.settling_time_s if gains.predicted else None
    chosen = (gains.margins, gains.overshoot, settling_s, gains.jitter)
    table.add_row(f"[bold]{gains.goal or gains.rule}[/bold]", *_numbers(best, *chosen), end_section=True)
    for other in gains.alternatives:
        if rules is None or other.rule in rules:
            row = (other.margins, other.overshoot, other.settling_time_s, other.jitter)
            table.add_row(other.rule, *_numbers(other.gains, *row))
    console.print(table)
    console.print(f"[dim]{OF_WHAT}[/dim]")


OF_WHAT = "Oversh. and settles (within 2 %): after a set-point step. Output: standard deviation that the noise causes."


def show_chosen(console: Console, gains: PidDesign) -> None:
    """Print the advised controller, and the gains to use: in the form of a known device and in the ideal form."""
    if gains.advice:
        console.print(f"controller advised: {gains.advice}")
    best = gains.held.gains if gains.held else gains.gains
    show_items(console, "ideal form:", controller_items(best))
    if gains.held:
        stated = [f"[bold]{name} {value:.6g}[/bold]" for name, value in gains.held.labelled.items()]
        acting = gains.held.device.action.words
        show_items(console, f"[bold]in the device[/bold] ({gains.held.form}):", [*stated, acting])


def controller_items(gains: PidGains) -> list[str]:
    """Return the numbers of a controller, each with its unit."""
    items = [
        f"[bold]Kp {gains.Kp:.5g}[/bold]",
        "[bold]no Ti[/bold]" if math.isinf(gains.Ti) else f"[bold]Ti {gains.Ti:.5g} s[/bold]",
        f"[bold]Td {gains.Td:.5g} s[/bold]",
        f"set-point weight b {gains.b:.3g}",
    ]
    if math.inf > gains.N:
        items.append(f"derivative filter Td/{gains.N:.3g}")
    if gains.Tf > 0.0:
        items.append(f"measurement filter Tf {gains.Tf:.4g} s")
    return items


def show_device_gains(console: Console, result: Mapping[str, Any], what: str) -> None:
    """Print gains of a device before and now, as `Applied.to_dict` and `RolledBack.to_dict` return them."""
    console.print(f"[bold]{result['loop']}[/bold]: gains {what}")
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("signal", no_wrap=True)
    for title in ("before", "now"):
        table.add_column(title, justify="right", no_wrap=True)
    before, now = result["old"]["values"], result["now"]["values"]
    for name, value in now.items():
        table.add_row(name, f"{before[name]:.6g}", f"{value:.6g}")
    console.print(table)
    if gains := result["now"].get("gains"):
        action = f", {Action(result['controller_action']).words}" if "controller_action" in result else ""
        console.print(f"in the ideal form: {gains_from_dict(gains).words}{action}")
    if result.get("margins"):
        console.print(f"on the model: Ms {result['margins']['Ms']:.2f}")
    for warning in result.get("warnings", ()):
        console.print(f"[yellow]warning:[/yellow] {warning}")


def show_messages(console: Console, warnings: Sequence[str], notes: Sequence[str]) -> None:
    """Print warnings, then notes."""
    for warning in warnings:
        console.print(f"[yellow]warning:[/yellow] {warning}")
    for note in notes:
        console.print(f"[dim]note:[/dim] {note}")


def _show_in_device(console: Console, tuning: TuningRun) -> None:
    if tuning.applied is not None:
        show_device_gains(console, tuning.applied.to_dict(), "written and read back")
    if tuning.verification is not None:
        show_verification(console, tuning.verification)


def show_verification(console: Console, run: VerificationRun) -> None:
    """Print the results of a step under the new gains."""
    if run.scenario is not None and run.band is not None and run.overshoot is not None:
        console.print(
            f"step of {run.scenario.set_point_step:.4g}: overshoot {100.0 * run.overshoot:.1f} %, predicted "
            f"{100.0 * run.band.nominal.overshoot:.1f} %"
        )
    if run.verdict is not None:
        back = "; the old gains are restored" if run.rolled_back else ""
        colour = "green" if run.passed else "red"
        console.print(f"[{colour}]{run.verdict.code}[/{colour}]: {run.verdict.message}{back}")


def _numbers(
    gains: PidGains,
    margins: Margins | None,
    overshoot: float | None,
    settling_s: float | None,
    jitter: float | None,
) -> list[str]:
    numbers = [f"{gains.Kp:.3g}", "none" if math.isinf(gains.Ti) else f"{gains.Ti:.3g}", f"{gains.Td:.3g}"]
    if margins is None:
        return numbers
    if not margins.stable:
        return [*numbers, "[red]unstable[/red]"]
    return [
        *numbers,
        f"{margins.Ms:.2f}",
        "" if overshoot is None else f"{100.0 * overshoot:.0f} %",
        "" if settling_s is None else f"{settling_s:.3g} s",
        "" if jitter is None else f"{jitter:.2g}",
    ]
