"""An open file that goes with the arguments of a process: the same file there, under a number of its own."""

from __future__ import annotations

import sys
from typing import Any


class SharedFile:
    """An open file; may be pickled while a process is started, and nowhere else.

    Attributes
    ----------
    number : int
        Its descriptor in this process.
    """

    def __init__(self, number: int) -> None:
        self.number = number

    def __reduce__(self) -> tuple[Any, ...]:
        """Have it duplicated for the process that is being started."""
        if sys.platform == "win32":
            raise NotImplementedError("files are not shared on this system")
        from multiprocessing.reduction import DupFd  # noqa: PLC0415 - has none on Windows

        return _detached, (DupFd(self.number),)


def _detached(duplicate: Any) -> SharedFile:
    return SharedFile(duplicate.detach())
