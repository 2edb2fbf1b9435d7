"""Writing the report of a tuning to a file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.errors import InputError, RecordingError
from autotuner.reports.diagnosis import diagnosis_sections
from autotuner.reports.tuning import Setting, report

if TYPE_CHECKING:
    from pathlib import Path

    from autotuner.configuration import LoopTable
    from autotuner.runtime.tuning import Tuning


def write_report(tuning: Tuning, loop: LoopTable, file: Path) -> None:
    """Write the report of a tuning; raise `InputError` when the file cannot be written."""
    try:
        recording = tuning.recording()
    except RecordingError:
        recording = None
    diagnosis = tuning.analysis.diagnosis if tuning.analysis else None
    found = [] if diagnosis is None else diagnosis_sections(diagnosis)
    text = report(
        tuning.to_dict(), recording, Setting(loop.driver, loop.pv_unit, loop.output_unit, extra=found, wish=tuning.wish)
    )
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"cannot be written: {error.strerror}", field="--report", value=str(file), remedy="Choose another place."
        ) from error
