"""`/v1/tunings/{id}/report`: everything about a tuning as one HTML file."""

from typing import Any

from fastapi import APIRouter, Response

from autotuner.errors import UnknownTuningError
from autotuner.reports.choices import OnOffer, basis_told, recording_of
from autotuner.reports.diagnosis import diagnosis_sections
from autotuner.reports.document import POLICY, Section
from autotuner.reports.tuning import Setting, report
from autotuner.runtime.analysis import Analysis
from autotuner.runtime.manager import Manager
from autotuner.service.context import AnalysisOf, ManagerOf, Seen, SeenOf
from autotuner.service.offered import offered
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
    told, recording, on_offer = tuning.to_dict(), recording_of(tuning), None
    if tuning.model is not None:
        on_offer = await offered(manager, tuning, basis_told(told, recording))
    setting = setting_of(manager, tuning, analysis, on_offer)
    text = await manager.arithmetic.run(report, told, recording, setting)
    name = f'inline; filename="tuning-{tuning.id}.html"'
    return Response(text, media_type=HTML, headers={"Content-Security-Policy": POLICY, "Content-Disposition": name})


def setting_of(manager: Manager, tuning: Seen, analysis: Analysis | None, on_offer: OnOffer | None) -> Setting:
    """Return where a tuning was done; a loop that is configured no more is told by its name only."""
    table, diagnosed = manager.configuration.loops.get(tuning.loop), _diagnosed(analysis)
    units = (table.driver, table.pv_unit, table.output_unit) if table else ("", "", "")
    return Setting(*units, extra=diagnosed, wish=tuning.wish, on_offer=on_offer)


def _diagnosed(analysis: Analysis | None) -> list[Section]:
    """Return what the diagnosis found, as sections."""
    diagnosis = analysis.diagnosis if analysis else None
    return [] if diagnosis is None else diagnosis_sections(diagnosis)
