"""Curves for display: the plan of a test, measurement against model, and predicted responses of each goal.

Invariant: plotting code is imported by the first request that needs it, to keep it out of a service that only tunes.
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
from autotuner.service.context import AnalysisOf, ComputationsOf, ManagerOf, SeenOf
from autotuner.service.problems import documented
from autotuner.service.schemas import requests, views
from autotuner.service.schemas.diagnosis import DiagnosisCurves

router = APIRouter(prefix="/v1", tags=["pictures"])

AS_CONFIGURED = requests.TuningStart()

Most = Annotated[int, Query(ge=100, le=20000, description="Most points of a curve.")]


@router.post("/loops/{loop:path}/plan", responses=documented(UnknownLoopError, InputError))
async def plan_tuning(
    loop: str, manager: ManagerOf, body: requests.TuningStart = AS_CONFIGURED, output: requests.PresentOutput = None
) -> views.Plan:
    """Return the plan of a tuning; nothing is moved."""
    table = manager.configuration.loop(loop)
    settings = table.experiment_settings(**body.overrides())
    planned = plan(settings, output, table.output_unit, table.pv_unit)
    return views.Plan.model_validate({**planned.to_dict(), "settings": settings.to_dict()})


@router.get("/tunings/{tuning_id}/curves", responses=documented(UnknownTuningError, TuningStateError, InputError))
async def get_curves(tuning: SeenOf, computations: ComputationsOf, most: Most = 4000) -> views.Curves:
    """Return measured and simulated PV and the residual, decimated without a visible change."""
    from autotuner.reports.curves import fit_curves  # noqa: PLC0415 - the rule of this file

    try:
        recording = tuning.recording()
    except RecordingError as error:
        raise TuningStateError(
            "has not recorded two samples", field="tuning", value=tuning.id, remedy="Check its phase or its verdict."
        ) from error
    return views.Curves.model_validate(await computations.run(fit_curves, recording, tuning.model, most))


@router.get("/tunings/{tuning_id}/before-after", responses=documented(UnknownTuningError, TuningStateError, InputError))
async def get_before_and_after(
    tuning: SeenOf, analysis: AnalysisOf, computations: ComputationsOf, most: Most = 4000
) -> DiagnosisCurves:
    """Return measured PV and the simulated one without and with the effects that the diagnosis names."""
    from autotuner.reports.curves import before_and_after  # noqa: PLC0415

    diagnosis = analysis.diagnosis if analysis else None
    if diagnosis is None or diagnosis.traces is None:
        raise TuningStateError(
            "has no diagnosis to draw", field="tuning", value=tuning.id, remedy="Upload its recording to /v1/diagnoses."
        )
    return DiagnosisCurves.model_validate(await computations.run(before_and_after, diagnosis.traces, most))


@router.get("/tunings/{tuning_id}/choices", responses=documented(UnknownTuningError, TuningStateError))
async def get_choices(tuning: SeenOf, computations: ComputationsOf) -> views.Choices:
    """Return the gains of every goal side by side: margins, predicted responses, and the device's own numbers."""
    from autotuner.reports.choices import basis_from_result, choices_of, installed_from_result  # noqa: PLC0415

    if tuning.model is None:
        raise TuningStateError(
            "has identified no process", field="tuning", value=tuning.id, remedy="Take one that ended with a model."
        )
    result, recording = tuning.to_dict(), tuning.recording()
    basis, installed = basis_from_result(result, recording), installed_from_result(result, recording)
    return views.Choices.model_validate({"choices": await computations.run(choices_of, basis, tuning.spec, installed)})
