"""`/v1/tunings/{id}/report`: everything about a tuning as one HTML file.

Invariant: report code is imported by the first request that needs it, to keep it out of a service that only
tunes.
"""

from typing import TYPE_CHECKING, Any

from fastapi import APIRouter, Response

from autotuner.errors import UnknownTuningError
from autotuner.service.context import AnalysisOf, ComputationsOf, ManagerOf, Seen, SeenOf
from autotuner.service.problems import documented

if TYPE_CHECKING:
    from autotuner.application.analysis.analysed import Analysis
    from autotuner.application.manager import Manager
    from autotuner.reports.document import Section
    from autotuner.reports.tuning import Setting

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
async def get_report(
    tuning: SeenOf, analysis: AnalysisOf, manager: ManagerOf, computations: ComputationsOf
) -> Response:
    """Return the report of a tuning, to keep, print or send: one file that loads nothing."""
    from autotuner.reports.choices import recording_of  # noqa: PLC0415 - the rule of this file
    from autotuner.reports.document import POLICY  # noqa: PLC0415
    from autotuner.reports.tuning import report  # noqa: PLC0415

    result, recording = tuning.to_dict(), recording_of(tuning)
    setting = setting_of(manager, tuning, analysis)
    text = await computations.run(report, result, recording, setting)
    name = f'inline; filename="tuning-{tuning.id}.html"'
    return Response(text, media_type=HTML, headers={"Content-Security-Policy": POLICY, "Content-Disposition": name})


def setting_of(manager: "Manager", tuning: Seen, analysis: "Analysis | None") -> "Setting":
    """Return the location of a tuning; a loop that is no longer configured has a name only."""
    from autotuner.reports.choices import fitted_until_s  # noqa: PLC0415
    from autotuner.reports.tuning import Setting  # noqa: PLC0415

    table = manager.configuration.loops.get(tuning.loop)
    units = (table.driver, table.pv_unit, table.output_unit) if table else ("", "", "")
    diagnosed = _diagnosed(analysis, *units[1:])
    return Setting(*units, extra=diagnosed, spec=tuning.spec, fitted_until_s=fitted_until_s(analysis))


def _diagnosed(analysis: "Analysis | None", pv_unit: str, output_unit: str) -> "list[Section]":
    """Return the diagnosis as sections."""
    from autotuner.reports.diagnosis import diagnosis_sections  # noqa: PLC0415
    from autotuner.reports.numbers import Units  # noqa: PLC0415

    diagnosis = analysis.diagnosis if analysis else None
    units = Units.of(pv_unit, output_unit)
    return [] if diagnosis is None else diagnosis_sections(diagnosis, units, of_a_tuning=True)
