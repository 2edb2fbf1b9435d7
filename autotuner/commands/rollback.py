"""`autotuner rollback`: the other half of `autotuner apply`."""

from __future__ import annotations

from autotuner.commands.apply import RollbackCommand

command = RollbackCommand()
