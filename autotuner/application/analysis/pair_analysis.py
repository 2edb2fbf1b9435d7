"""Interaction of two loops from the records of their tunings.

Each record holds the test of one loop and, in a further column, the PV of the other one, which was in manual: its own
columns give the loop's process and gains, the further column the path to the other PV. Where the other output moved
too, as in a historian's export, it is a measured disturbance of the loop's own PV, and what is fitted of it is the path
from there: one fit explains each PV by both outputs.

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
from autotuner.core.identification.measured_disturbances import SILENT
from autotuner.core.model.process import InverseResponse, InverseResponseUnderdamped, model_to_dict, second_order
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.design import PidGains
    from autotuner.core.identification import Identification
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
    other_output: tuple[str | None, str | None] = (None, None),
) -> PairAnalysis:
    """Analyse the interaction of two loops.

    Parameters
    ----------
    records : tuple of Recording
        The test of each loop, with the PV of the other one among its further columns.
    other_pv : tuple of str or None
        Name of that column in each record; None where it is the only one. Not needed where the other output moved.
    spec : DesignSpec, optional
        The requested design of each loop.
    limit : float, optional
        Largest Ms and Mt of the remedies; those of the requested design by default.
    other_output : tuple of str or None
        Name of the column of the other loop's output in each record in which it moved too.

    Raises
    ------
    InputError
        A record shows no process, its column of the other PV is missing, or a path cannot be identified.
    """
    requested = spec or DesignSpec()
    one, two = (_own(*each, requested) for each in zip(records, other_output, strict=True))
    on_second = _path(records[0], other_pv[0]) if other_output[1] is None else two.from_other
    on_first = _path(records[1], other_pv[1]) if other_output[0] is None else one.from_other
    pair = Pair(one.process, two.process, on_first, on_second, (one.gains, two.gains))
    largest = requested.requirements(None, None).Ms if limit is None else limit
    return PairAnalysis(
        pair, interaction(pair), {name: _remedy(make, pair, largest) for name, make in REMEDIES.items()}
    )


@dataclass(frozen=True, slots=True)
class _Own:
    """A loop as its controller sees it, its gains, and the path from the other output where that moved and shows."""

    process: ProcessModel
    gains: PidGains
    from_other: ProcessModel | None


def _own(record: Recording, moved: str | None, spec: DesignSpec) -> _Own:
    """Return what the record of a loop shows of its own PV; `moved` is the column of the other output."""
    found = identify(record, disturbances=() if moved is None else (moved,))
    if found.model is None:
        raise InputError(found.verdict.message, field="record", remedy=found.verdict.remedy)
    every_s = record.sample_interval_s
    judged = judged_process(found.model, every_s)[0]
    assert judged is not None  # noqa: S101 - there is a model
    gains = gains_for(found, spec, every_s).gains
    return _Own(judged, gains, None if moved is None else _from_other(found, moved, every_s))


def _from_other(found: Identification, moved: str, every_s: float) -> ProcessModel | None:
    """Return the path from the other output, through the lags of the process; None where the PV shows no answer."""
    assert found.model is not None  # noqa: S101 - asked before
    if found.disturbances:
        (other,) = found.disturbances
        return judged_process(_with_gain(found.model, other.gain, other.D), every_s)[0]
    if SILENT.format(moved) in found.warnings:
        return None
    raise InputError(
        "cannot be distinguished from the loop's own output in this record",
        field=moved,
        remedy="Move the two outputs at different times, and more often.",
    )


def _with_gain(model: ProcessModel, gain: float, D: float) -> ProcessModel:
    """Return a process with other gain and dead time, and without a zero: a load goes through its lags alone."""
    if isinstance(model, InverseResponse | InverseResponseUnderdamped):
        _, a1, a2 = model.rational().a
        return second_order(gain, a2, a1, D)
    return replace(model, K=gain, D=D)  # type: ignore[type-var]


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
            remedy="Keep the other loop in manual during the test; repeat it with a larger amplitude. Where its output "
            "moved, name that.",
        )
    return None if found.model is None else judged_process(found.model, record.sample_interval_s)[0]


def _remedy(make: Callable[[Pair, float], Remedy], pair: Pair, limit: float) -> Remedy | str:
    try:
        return make(pair, limit)
    except InputError as error:
        return error.finding
