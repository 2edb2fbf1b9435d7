"""`autotuner serve`: the REST service."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.commands.files.configured import add_configuration, configuration_of
from autotuner.commands.terminal.usage import WholeNumber, add_examples

if TYPE_CHECKING:
    import argparse

    from autotuner.configuration import Configuration


@dataclass(frozen=True, slots=True)
class ServeCommand:
    """Run the service."""

    help: str = "Run the REST service on loopback; a simulated loop is served without a configuration."

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        add_configuration(parser, "TOML file of loops (default: autotuner.toml, else a demo loop)")
        parser.add_argument("--host", help="address to listen on (default: service.host, 127.0.0.1)")
        parser.add_argument("--port", type=WholeNumber(0), help="port, 0 for any (default: service.port, 8321)")
        parser.add_argument("--json", action="store_true", help="print the address as one JSON object")
        add_examples(parser, "autotuner serve", "autotuner serve --config loops.toml --port 8080")

    def run(self, args: argparse.Namespace) -> int:
        """Serve until stopped."""
        from autotuner.service.serve import serve  # noqa: PLC0415 - keeps `--help` quick

        def read() -> Configuration:
            return configuration_of(args).listening_on(args.host, args.port)

        return serve(read(), read, as_json=args.json)


command = ServeCommand()
