"""`autotuner check`: a configuration, checked without moving anything."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.configuration import load_configuration

if TYPE_CHECKING:
    import argparse


@dataclass(frozen=True, slots=True)
class CheckCommand:
    """Check a configuration."""

    help: str = "Check a configuration: every key, every driver's options. Nothing is connected or moved."

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument("config", nargs="?", type=Path, help="TOML file of loops (default: autotuner.toml)")

    def run(self, args: argparse.Namespace) -> int:
        """Make every loop's backend without opening it."""
        from autotuner.runtime.device_gains import device_form  # noqa: PLC0415 - keeps `--help` quick
        from autotuner.runtime.plugins import make_backend  # noqa: PLC0415
        from autotuner.runtime.ranges import check_ranges  # noqa: PLC0415

        configuration = load_configuration(args.config)
        for name, loop in configuration.loops.items():
            backend = make_backend(loop.driver, loop.device, f"loops.{name}")
            check_ranges(loop.experiment_settings().limits, backend, f"loops.{name}")
            form = device_form(loop, backend, f"loops.{name}")
            gains = f"; gains as {form.form.title}" if form else ""
            sys.stdout.write(f"{name}: driver {loop.driver}, reads {', '.join(sorted(backend.readable))}{gains}\n")
        return 0


command = CheckCommand()
