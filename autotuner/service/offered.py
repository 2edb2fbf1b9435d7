"""The gains that can be chosen for a tuning's loop, as its page and its report show them.

Rule of this file: what draws and reports is imported when somebody looks: a service that tunes has it not in memory.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from autotuner.core.tuning.wish import Basis
    from autotuner.reports.choices import OnOffer
    from autotuner.runtime.manager import Manager
    from autotuner.service.context import Seen


async def offered(manager: Manager, tuning: Seen, basis: Basis) -> OnOffer:
    """Return what can be chosen for a tuning with a model; without a device where the loop is configured no more."""
    from autotuner.reports.choices import OnOffer, in_device, offers_of  # noqa: PLC0415 - the rule of this file

    offers = await manager.arithmetic.run(offers_of, basis, tuning.wish)
    table = manager.configuration.loops.get(tuning.loop)
    if table is None:
        return OnOffer(offers)
    return in_device(offers, basis.model, manager.desk(tuning.loop).held, table.gains)
