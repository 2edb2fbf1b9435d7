"""`autotuner token`: management of access to the service."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.commands.files.audit_trail import audited
from autotuner.commands.files.configured import add_configuration, configuration_of
from autotuner.commands.terminal.output import show
from autotuner.commands.terminal.usage import add_examples, words

if TYPE_CHECKING:
    import argparse

ROLES = ("viewer", "operator")


@dataclass(frozen=True, slots=True)
class TokenCommand:
    """Make, list and revoke tokens."""

    help: str = "Make, list and revoke the tokens with which people and programs reach the service."

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
        add = actions.add_parser("add", help="make a token and print it; it is shown this once")
        add.add_argument("name", help="the person or program that gets it")
        add.add_argument(
            "--role",
            type=words(*ROLES),
            metavar="{viewer,operator}",
            required=True,
            help="a viewer reads, an operator moves outputs too",
        )
        revoke = actions.add_parser("revoke", help="make a token worthless at once")
        revoke.add_argument("name", help="whose")
        for action in (add, revoke, actions.add_parser("list", help="print names, roles and dates")):
            add_configuration(action, "TOML file, for service.data_directory")
        add_examples(parser, "autotuner token add anna --role operator", "autotuner token revoke anna")

    def run(self, args: argparse.Namespace) -> int:
        """Do it."""
        from autotuner.service.security.tokens import Role, tokens_of  # noqa: PLC0415 - keeps `--help` quick

        service = configuration_of(args).service
        tokens = tokens_of(service.data_directory)
        if args.action == "add":
            with audited(service, f"autotuner token add {args.name} ({args.role})"):
                show(tokens.add(args.name, Role(args.role)) + "\n")
        elif args.action == "revoke":
            with audited(service, f"autotuner token revoke {args.name}"):
                tokens.revoke(args.name)
        else:
            for token in tokens.all():
                ended = f", revoked {token.revoked_at}" if token.revoked_at else ""
                show(f"{token.name}: {token.role.value}, made {token.made_at}{ended}\n")
        return 0


command = TokenCommand()
