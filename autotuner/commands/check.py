"""`autotuner check`: a configuration, checked without moving anything."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.commands.files.configured import (
    CONFIGURATION,
    add_data_directory,
    configuration_of,
    journal_of,
    report_left,
)
from autotuner.commands.terminal.output import say, show
from autotuner.commands.terminal.usage import add_examples
from autotuner.control.devices.plugins import is_simulated
from autotuner.errors import ConfigurationError

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

    from autotuner.configuration import LoopTable
    from autotuner.core.design.forms.pid_forms import Form
    from autotuner.ports import Backend


@dataclass(frozen=True, slots=True)
class CheckCommand:
    """Check a configuration."""

    help: str = "Check a configuration: every key, every driver's options. Nothing is connected or moved."

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument("config", nargs="?", type=Path, help=CONFIGURATION)
        add_data_directory(parser)
        parser.add_argument(
            "--confirm",
            metavar="LOOP",
            help="confirm that you have set output and mode of a loop by hand, after an interrupted run",
        )
        add_examples(parser, "autotuner check loops.toml", "autotuner check loops.toml --confirm TIC-101")

    def run(self, args: argparse.Namespace) -> int:
        """Make every loop's backend without opening it."""
        from autotuner.control.devices.device_gains import device_form  # noqa: PLC0415 - keeps `--help` quick
        from autotuner.control.devices.plugins import make_backend  # noqa: PLC0415
        from autotuner.control.devices.ranges import check_ranges  # noqa: PLC0415

        configuration = configuration_of(args)
        journal = journal_of(configuration)
        if args.confirm is not None:
            journal.confirm(args.confirm, configuration.loop(args.confirm).device_key)
        for name, loop in configuration.loops.items():
            backend = make_backend(loop.driver, loop.device, f"loops.{name}")
            check_ranges(loop.experiment_settings().limits, backend, f"loops.{name}")
            _require_limits(name, loop, backend)
            form = device_form(loop, backend, f"loops.{name}")
            gains = f"; gains as {form.form.title}" if form else ""
            show(f"{name}: driver {loop.driver}, reads {', '.join(sorted(backend.readable))}{gains}\n")
            if form is not None and form.form.mode is not None:
                _report_mode(name, form.form, loop.device)
            report_left(journal, name, loop)
        return 0


def _require_limits(name: str, loop: LoopTable, backend: Backend) -> None:
    """Refuse a loop of a real device without configured limits."""
    missing = {"output", "pv"} - loop.limits.model_fields_set
    if missing and not is_simulated(backend):
        raise ConfigurationError(
            "is missing: a loop of a real device needs the limits of its process",
            field=f"loops.{name}.limits.{min(missing)}",
            remedy="Give the lowest and the highest value that output and PV may ever have.",
        )


def _report_mode(name: str, form: Form, device: Mapping[str, object]) -> None:
    """Report on standard error that a device of this form counts its modes the other way round than the table does."""
    tables = [table for table in device.values() if isinstance(table, dict)]
    auto = next((table["auto"] for table in tables if isinstance(table.get("auto"), dict)), None)
    mode = form.mode
    if auto is None or mode is None or {"auto_pulse", "auto_call"} & auto.keys():
        return
    held = {key: auto.get(key, default) for key, default in (("auto_value", 1), ("manual_value", 0))}
    values = {key: value if isinstance(value, list) else [value] for key, value in held.items()}
    if set(values["auto_value"]) & set(mode.manual) or set(values["manual_value"]) & set(mode.auto):
        say(
            f"loops.{name}.device: auto has auto_value {held['auto_value']} and manual_value "
            f"{held['manual_value']}, but {mode.signal} of {form.title} is {_values(mode.auto)} in automatic and "
            f"{_values(mode.manual)} in manual. Correct auto_value and manual_value, unless auto is another signal."
        )


def _values(raws: tuple[int, ...]) -> str:
    return " or ".join(map(str, raws)) or "not known"


command = CheckCommand()
