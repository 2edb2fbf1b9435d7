"""Writing the report of a tuning to a file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.reports.choices import fitted_until_s, recording_of
from autotuner.reports.diagnosis import diagnosis_sections
from autotuner.reports.numbers import Units
from autotuner.reports.tuning import Setting, report

if TYPE_CHECKING:
    from pathlib import Path

    from autotuner.application.tuning_run import TuningRun
    from autotuner.configuration import LoopTable


def write_report(tuning: TuningRun, loop: LoopTable, file: Path) -> None:
    """Write the report of a tuning."""
    recording = recording_of(tuning)
    diagnosis = tuning.analysis.diagnosis if tuning.analysis else None
    units = Units.of(loop.pv_unit, loop.output_unit)
    found = [] if diagnosis is None else diagnosis_sections(diagnosis, units, of_a_tuning=True)
    setting = Setting(
        loop.driver,
        loop.pv_unit,
        loop.output_unit,
        extra=found,
        spec=tuning.spec,
        fitted_until_s=fitted_until_s(tuning.analysis),
    )
    text = report(tuning.to_dict(), recording, setting)
    file.write_text(text, encoding="utf-8")
