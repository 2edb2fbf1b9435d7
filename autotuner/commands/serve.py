"""`autotuner serve`: the REST service."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.configuration import load_configuration

if TYPE_CHECKING:
    import argparse

    from autotuner.configuration import Configuration


@dataclass(frozen=True, slots=True)
class ServeCommand:
    """Run the service."""

    help: str = "Run the REST service on loopback; a simulated loop is served without a configuration."

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument(
            "--config", type=Path, help="TOML file of loops (default: autotuner.toml, else a demo loop)"
        )
        parser.add_argument("--host", help="address to listen on (default: service.host, 127.0.0.1)")
        parser.add_argument("--port", type=int, help="port to listen on, 0 for any (default: service.port, 8321)")

    def run(self, args: argparse.Namespace) -> int:
        """Serve until stopped."""
        from autotuner.service.serve import serve  # noqa: PLC0415 - keeps `--help` quick

        def read() -> Configuration:
            return load_configuration(args.config).listening_on(args.host, args.port)

        return serve(read(), read)


command = ServeCommand()
