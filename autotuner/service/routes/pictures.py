"""What a person looks at: what a test will do, measured against model, and what the gains of each goal will do.

Rule of this file: what draws is imported when somebody looks (`autotuner.service.offered`).
"""

from typing import Annotated

from fastapi import APIRouter, Query

from autotuner.errors import (
    InputError,
    RecordingError,
    TuningStateError,
    UnknownLoopError,
    UnknownTuningError,
)
from autotuner.reports.plan import plan
from autotuner.service import asked, shown
from autotuner.service.context import AnalysisOf, ManagerOf, SeenOf
from autotuner.service.diagnosis import DiagnosisCurves
from autotuner.service.offered import offered
from autotuner.service.problems import documented

router = APIRouter(prefix="/v1", tags=["pictures"])

AS_CONFIGURED = asked.TuningStart()

Most = Annotated[int, Query(ge=100, le=20000, description="Most points of a curve.")]


@router.post("/loops/{loop:path}/plan", responses=documented(UnknownLoopError, InputError))
async def plan_tuning(
    loop: str, manager: ManagerOf, body: asked.TuningStart = AS_CONFIGURED, output: asked.PresentOutput = None
) -> shown.Plan:
    """Tell what a tuning will do; nothing is moved."""
    table = manager.configuration.loop(loop)
    settings = table.experiment_settings(**body.overrides())
    planned = plan(settings, output, table.output_unit, table.pv_unit)
    return shown.Plan.model_validate({**planned.to_dict(), "settings": settings.to_dict()})


@router.get("/tunings/{tuning_id}/curves", responses=documented(UnknownTuningError, TuningStateError, InputError))
async def get_curves(tuning: SeenOf, manager: ManagerOf, most: Most = 4000) -> shown.Curves:
    """Return measured and simulated PV and the residual, thinned so that a picture of them looks as one of all."""
    from autotuner.reports.curves import fit_curves  # noqa: PLC0415 - the rule of this file

    try:
        recording = tuning.recording()
    except RecordingError as error:
        raise TuningStateError(
            "has not recorded two samples", field="tuning", value=tuning.id, remedy="Look at its phase or its verdict."
        ) from error
    return shown.Curves.model_validate(await manager.arithmetic.run(fit_curves, recording, tuning.model, most))


@router.get("/tunings/{tuning_id}/before-after", responses=documented(UnknownTuningError, TuningStateError, InputError))
async def get_before_and_after(
    tuning: SeenOf, analysis: AnalysisOf, manager: ManagerOf, most: Most = 4000
) -> DiagnosisCurves:
    """Return measured PV and the simulated one without and with the effects that the diagnosis names."""
    from autotuner.reports.curves import before_and_after  # noqa: PLC0415

    diagnosis = analysis.diagnosis if analysis else None
    if diagnosis is None or diagnosis.traces is None:
        raise TuningStateError(
            "has no diagnosis to draw", field="tuning", value=tuning.id, remedy="Upload its recording to /v1/diagnoses."
        )
    return DiagnosisCurves.model_validate(await manager.arithmetic.run(before_and_after, diagnosis.traces, most))


@router.get("/tunings/{tuning_id}/choices", responses=documented(UnknownTuningError, TuningStateError))
async def get_choices(tuning: SeenOf, manager: ManagerOf) -> shown.Choices:
    """Return the gains of every goal side by side: margins, predicted responses, and the device's own numbers."""
    from autotuner.reports.choices import basis_told, choices_of, installed_told  # noqa: PLC0415

    if tuning.model is None:
        raise TuningStateError(
            "has identified no process", field="tuning", value=tuning.id, remedy="Take one that ended with a model."
        )
    told, recording = tuning.to_dict(), tuning.recording()
    basis = basis_told(told, recording)
    on_offer = await offered(manager, tuning, basis)
    installed = installed_told(told, recording, on_offer.derivative_filter)
    return shown.Choices.model_validate(
        {"choices": await manager.arithmetic.run(choices_of, basis, on_offer, installed)}
    )
