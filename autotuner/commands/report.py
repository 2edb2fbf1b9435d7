"""Writing the report of a tuning to a file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.errors import InputError
from autotuner.reports.choices import basis_told, in_device, offers_of, recording_of
from autotuner.reports.diagnosis import diagnosis_sections
from autotuner.reports.tuning import Setting, report

if TYPE_CHECKING:
    from pathlib import Path

    from autotuner.configuration import LoopTable
    from autotuner.runtime.gains_desk import GainsDesk
    from autotuner.runtime.tuning import Tuning


def write_report(tuning: Tuning, loop: LoopTable, desk: GainsDesk, file: Path) -> None:
    """Write the report of a tuning; raise `InputError` when the file cannot be written."""
    recording = recording_of(tuning)
    diagnosis = tuning.analysis.diagnosis if tuning.analysis else None
    found = [] if diagnosis is None else diagnosis_sections(diagnosis, of_a_tuning=True)
    told, on_offer = tuning.to_dict(), None
    if tuning.model is not None:
        offers = offers_of(basis_told(told, recording), tuning.wish)
        on_offer = in_device(offers, tuning.model, desk.held, loop.gains)
    units = (loop.driver, loop.pv_unit, loop.output_unit)
    text = report(told, recording, Setting(*units, extra=found, wish=tuning.wish, on_offer=on_offer))
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"cannot be written: {error.strerror}", field="--report", value=str(file), remedy="Choose another place."
        ) from error
