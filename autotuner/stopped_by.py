"""Which signals end a program: one list for the commands and for the service."""

from __future__ import annotations

import signal

NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")


def stopped_by() -> list[signal.Signals]:
    """Return them; not that of a closed terminal where the program is to outlive it, as under `nohup`."""
    known = [signal.Signals[name] for name in NAMES if hasattr(signal, name)]
    return [one for one in known if one.name != "SIGHUP" or signal.getsignal(one) is not signal.SIG_IGN]


def suspended_by() -> list[signal.Signals]:
    """Return the signal of Ctrl-Z, where the system has it; a loop is released before a program suspends itself."""
    return [signal.Signals["SIGTSTP"]] if hasattr(signal, "SIGTSTP") else []
