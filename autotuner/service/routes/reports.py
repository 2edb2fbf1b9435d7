"""`/v1/tunings/{id}/report`: everything about a tuning as one HTML file."""

from typing import Any

from fastapi import APIRouter, Response

from autotuner.errors import AutotunerError, RecordingError, UnknownTuningError
from autotuner.reports.diagnosis import diagnosis_sections
from autotuner.reports.document import POLICY, Section
from autotuner.reports.tuning import Setting, report
from autotuner.runtime.analysis import Analysis
from autotuner.runtime.manager import Manager
from autotuner.service.context import AnalysisOf, ManagerOf, Seen, SeenOf
from autotuner.service.problems import documented

router = APIRouter(prefix="/v1", tags=["tunings"])

HTML = "text/html"
RENDERED: dict[int | str, dict[str, Any]] = {
    200: {"description": "The report", "content": {HTML: {"schema": {"type": "string"}}}}
}


@router.get(
    "/tunings/{tuning_id}/report",
    response_class=Response,
    responses=RENDERED | documented(UnknownTuningError),
)
async def get_report(tuning: SeenOf, analysis: AnalysisOf, manager: ManagerOf) -> Response:
    """Return the report of a tuning, to keep, print or send: one file that loads nothing."""
    try:
        recording = tuning.recording()
    except RecordingError:
        recording = None
    text = await manager.arithmetic.run(report, tuning.to_dict(), recording, setting_of(manager, tuning, analysis))
    name = f'inline; filename="tuning-{tuning.id}.html"'
    return Response(text, media_type=HTML, headers={"Content-Security-Policy": POLICY, "Content-Disposition": name})


def setting_of(manager: Manager, tuning: Seen, analysis: Analysis | None) -> Setting:
    """Return where a tuning was done; a loop that is configured no more is told by its name only."""
    table, diagnosed = manager.configuration.loops.get(tuning.loop), _diagnosed(analysis)
    if table is None:
        return Setting(extra=diagnosed, wish=tuning.wish)
    device = _in_device(manager, tuning.loop, analysis)
    return Setting(table.driver, table.pv_unit, table.output_unit, extra=diagnosed, device=device, wish=tuning.wish)


def _diagnosed(analysis: Analysis | None) -> list[Section]:
    """Return what the diagnosis found, as sections."""
    diagnosis = analysis.diagnosis if analysis else None
    return [] if diagnosis is None else diagnosis_sections(diagnosis)


def _in_device(manager: Manager, loop: str, analysis: Analysis | None) -> dict[str, dict[str, float]]:
    """Return the device's own numbers of the tuning's gains."""
    if analysis is None or analysis.gains is None:
        return {}
    try:
        planned = manager.desk(loop).planned(analysis.gains.gains, analysis.identification.model)
    except AutotunerError:
        return {}
    return {analysis.gains.goal or analysis.gains.rule: planned.held.labelled}
