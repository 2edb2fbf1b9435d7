"""Output and end of commands: one prefix, one set of exit codes, no traceback for a closed pipe.

Invariants:

1. A character that the encoding lacks is replaced; it never ends a command.
2. A standard stream that is closed or full changes nothing on a device: messages for people are given up, results that
   cannot be printed are reported by the exit code.
3. Exit codes: 0 done, 1 failed with a reason, 2 wrong usage.
"""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from autotuner.errors import AutotunerError, ConfigurationError, InputError, RecordingError, UnknownLoopError

if TYPE_CHECKING:
    from collections.abc import Iterator

EXIT_CODES: dict[type[AutotunerError], int] = {
    ConfigurationError: 2,
    UnknownLoopError: 2,
    RecordingError: 1,
    InputError: 2,
    AutotunerError: 1,
}
"""Exit code by class of error; the first class that fits counts."""


class OutputError(AutotunerError):
    """Standard output cannot be written."""


def exit_code(error: AutotunerError) -> int:
    """Return the exit code of a command that ends with an error."""
    return next(code for kind, code in EXIT_CODES.items() if isinstance(error, kind))


def say(message: object) -> None:
    """Write a message for people to standard error, if that can be written."""
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.write(f"autotuner: {message}\n")
        sys.stderr.flush()


def show(text: str) -> None:
    """Write a result to standard output.

    Raises
    ------
    OutputError
        Nothing can be written there; its cause is chained.
    """
    with writing():
        sys.stdout.write(text)


@contextlib.contextmanager
def writing() -> Iterator[None]:
    """Write results to standard output in the block; raise `OutputError` when that cannot be done."""
    try:
        yield
        sys.stdout.flush()
    except OSError as error:
        _give_up(sys.stdout)
        raise OutputError(
            f"cannot be written: {error.strerror or error}",
            field="standard output",
            remedy="Redirect it to a file on a disk with room.",
        ) from error


def prepare_streams() -> None:
    """Make the standard streams usable: a closed one goes nowhere, and no encoding refuses a character."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - until the end
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def finish() -> int:
    """Flush the standard streams; return the exit code of a failure, 0 for none."""
    try:
        with writing():
            pass
    except OutputError as error:
        return ended(error)
    return 0


def ended(error: AutotunerError) -> int:
    """Report an error and return its exit code. A reader that closes the pipe early, as `head`, is not an error."""
    if isinstance(error, OutputError) and isinstance(error.__cause__, BrokenPipeError):
        return 0
    say(error)
    return exit_code(error)


def _give_up(stream: TextIO) -> None:
    """Discard the pending output of a stream: the interpreter flushes it once more at exit."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
