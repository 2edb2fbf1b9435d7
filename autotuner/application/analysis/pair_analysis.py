"""Interaction of two loops from the records of their tunings.

Each record holds the test of one loop and, in a further column, the PV of the other one, which was in manual: its own
columns give the loop's process and gains, the further column the path to the other PV.

Invariants: a path without a response is zero; a path with a response that cannot be identified is refused, because
the pair would look better without it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

from autotuner.application.analysis.procedure import gains_for
from autotuner.core.design import DesignSpec
from autotuner.core.design.interaction import Interaction, Pair, Remedy, advice, decoupled, detuned, interaction
from autotuner.core.design.pid_design import judged_process
from autotuner.core.identification import identify
from autotuner.core.model.process import model_to_dict
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.design import PidGains
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

NO_PATH = "no_answer"
"""Verdict of a record whose PV does not respond to the output."""
REMEDIES: dict[str, Callable[[Pair, float], Remedy]] = {"detuned": detuned, "decoupled": decoupled}


@dataclass(frozen=True, slots=True)
class PairAnalysis:
    """Results of the records of two loops.

    Attributes
    ----------
    pair : Pair
        The processes, with the delay of the controllers' sampling, and the gains of each loop alone.
    interaction : Interaction
        What the loops do to each other.
    remedies : dict of str to Remedy or str
        Detuned and decoupled gains by name, or the reason for their absence.
    """

    pair: Pair
    interaction: Interaction
    remedies: dict[str, Remedy | str]

    @property
    def advice(self) -> str:
        """Advice."""
        return advice(self.interaction)

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        paths = {name: getattr(self.pair, name) for name in ("first", "second", "on_first", "on_second")}
        return {
            "processes": {name: None if model is None else model_to_dict(model) for name, model in paths.items()},
            "gains": [gains.to_dict() for gains in self.pair.gains],
            **self.interaction.to_dict(),
            "advice": self.advice,
            "remedies": {
                name: {"refused": found} if isinstance(found, str) else found.to_dict()
                for name, found in self.remedies.items()
            },
        }


def analyse_pair(
    records: tuple[Recording, Recording],
    other_pv: tuple[str | None, str | None] = (None, None),
    spec: DesignSpec | None = None,
    limit: float | None = None,
) -> PairAnalysis:
    """Analyse the interaction of two loops.

    Parameters
    ----------
    records : tuple of Recording
        The test of each loop, with the PV of the other one among its further columns.
    other_pv : tuple of str or None
        Name of that column in each record; None where it is the only one.
    spec : DesignSpec, optional
        The requested design of each loop.
    limit : float, optional
        Largest Ms and Mt of the remedies; those of the requested design by default.

    Raises
    ------
    InputError
        A record shows no process, its column of the other PV is missing, or a path cannot be identified.
    """
    requested = spec or DesignSpec()
    (first, gains1), (second, gains2) = (_own(record, requested) for record in records)
    on_second, on_first = (_path(record, name) for record, name in zip(records, other_pv, strict=True))
    pair = Pair(first, second, on_first, on_second, (gains1, gains2))
    largest = requested.requirements(None, None).Ms if limit is None else limit
    return PairAnalysis(
        pair, interaction(pair), {name: _remedy(make, pair, largest) for name, make in REMEDIES.items()}
    )


def _own(record: Recording, spec: DesignSpec) -> tuple[ProcessModel, PidGains]:
    """Return the process of a loop as its controller sees it, and its gains."""
    found = identify(record)
    if found.model is None:
        raise InputError(found.verdict.message, field="record", remedy=found.verdict.remedy)
    every_s = record.sample_interval_s
    judged = judged_process(found.model, every_s)[0]
    assert judged is not None  # noqa: S101 - there is a model
    return judged, gains_for(found, spec, every_s).gains


def _path(record: Recording, name: str | None) -> ProcessModel | None:
    """Return the path from a record's output to the other PV; None where that does not answer."""
    names = [name] if name is not None else list(record.extra)
    if len(names) != 1 or names[0] not in record.extra:
        raise InputError(
            "must hold the PV of the other loop in one further column",
            field="record",
            value=sorted(record.extra),
            remedy="Record the other PV along; where there are several columns, name it.",
        )
    cross = replace(record, pv=record.extra[names[0]], extra=MappingProxyType({}), settings=MappingProxyType({}))
    found = identify(cross)
    if found.model is None and found.verdict.code != NO_PATH:
        raise InputError(
            f"shows an answer that cannot be identified: {found.verdict.message}",
            field=names[0],
            remedy="Keep the other loop in manual during the test; repeat it with a larger amplitude.",
        )
    return None if found.model is None else judged_process(found.model, record.sample_interval_s)[0]


def _remedy(make: Callable[[Pair, float], Remedy], pair: Pair, limit: float) -> Remedy | str:
    try:
        return make(pair, limit)
    except InputError as error:
        return error.finding
