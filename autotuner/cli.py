"""The shell command `autotuner`.

Invariant: every expected error ends as one sentence with its remedy on standard error, and an exit code of
`autotuner.commands.terminal.output`.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from autotuner.commands.command_line import COMMANDS, command_line
from autotuner.commands.terminal.output import ended, finish, prepare_streams, say
from autotuner.errors import AutotunerError
from autotuner.linear_algebra_threads import use_one_thread

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code."""
    use_one_thread()
    prepare_streams()
    try:
        code = _run(list(sys.argv[1:] if argv is None else argv))
    except AutotunerError as error:
        return ended(error)
    except KeyboardInterrupt:
        say("interrupted")
        return 1
    return code or finish()


def _run(arguments: list[str]) -> int:
    name = next((word for word in arguments if not word.startswith("-")), None)
    parser, chosen = command_line(name)
    args = parser.parse(arguments)
    assert chosen is not None  # noqa: S101 - the parser refuses a command that is not there
    code = chosen.run(args)
    if name not in COMMANDS and hasattr(args, "data_directory"):
        from autotuner.commands.files.configured import report_left_of  # noqa: PLC0415 - only a command with state needs it

        report_left_of(args)
    return code


if __name__ == "__main__":
    sys.exit(main())
