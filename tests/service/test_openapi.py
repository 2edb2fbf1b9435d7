"""The API document: committed, not drifted, and kept to by the service whatever is asked of it."""

import asyncio
import inspect
import itertools
import json

import async_solipsism
import hypothesis
import pytest
import requests
import schemathesis
from schemathesis import checks
from schemathesis.generation import GenerationMode

from autotuner.configuration import RelayTable
from autotuner.service.app import ROUTERS
from autotuner.service.openapi import document
from autotuner.service.schemas import resources, views
from autotuner.service.schemas.requests import GainsSpec, TuningStart
from tests.service.conftest import DOCUMENT

OPERATIONS = [
    result.ok()
    for result in schemathesis.openapi.from_dict(json.loads(DOCUMENT.read_text(encoding="utf-8"))).get_all_operations()
]
CHECKS = [
    checks.not_a_server_error,
    *checks.CHECKS.get_by_names(
        [
            "status_code_conformance",
            "content_type_conformance",
            "response_headers_conformance",
            "response_schema_conformance",
            "negative_data_rejection",
        ]
    ),
]
KNOWN = {"loop": "heater", "tuning_id": "tuning-1", "schedule_id": "tuning-1"}
EXAMPLES, EXAMPLES_OF_COMPUTATIONS = 8, 2
"""Requests of an operation; and of one that computes for seconds."""
COMPUTED = ("/report", "/choices", "/gains")


def test_the_committed_document_has_not_drifted():
    assert DOCUMENT.read_text(encoding="utf-8") == document(), (
        "run: python -m autotuner.service.openapi > docs/openapi.json"
    )


def test_a_tuning_can_be_started_with_every_setting_of_the_configuration():
    assert set(TuningStart().overrides()) <= set(RelayTable.model_fields)
    others = {"structure", "budget_ms", "apply", "verify", *GainsSpec.model_fields}
    assert set(TuningStart.model_fields) - others == set(RelayTable.model_fields)


@pytest.mark.virtual_time
async def test_all_that_is_told_is_described(serving, undescribed):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        running = (await service.client.get("/v1/tunings/tuning-1")).json()
        await service.client.get("/v1/tunings/tuning-1/events")
        ended = (await service.client.get("/v1/tunings/tuning-1")).json()
        gains = (await service.client.post("/v1/tunings/tuning-1/gains", json={"rule": "simc_pi"})).json()
        columns = (await service.client.get("/v1/tunings/tuning-1/recording?format=json")).json()
        recording = (await service.client.get("/v1/tunings/tuning-1/recording")).text
        upload = await service.client.post(
            "/v1/identifications", content=recording, headers={"Content-Type": "text/csv"}
        )
    assert ended["tuning"]["alternatives"]
    for told in (running, ended):
        assert undescribed(resources.Tuning.model_validate(told)) == {}
    assert undescribed(resources.Gains.model_validate(gains)) == {}
    assert undescribed(resources.Recording.model_validate(columns)) == {}
    assert undescribed(views.Identification.model_validate(upload.json())) == {}


def test_every_endpoint_and_dependency_is_asynchronous():
    routes = [route for router in ROUTERS for route in router.routes]
    assert len(routes) == len(OPERATIONS)
    for called in itertools.chain.from_iterable(_called(route.dependant) for route in routes):
        assert inspect.iscoroutinefunction(called) or inspect.isasyncgenfunction(called), called


def _called(dependant):
    yield dependant.call
    for dependency in dependant.dependencies:
        yield from _called(dependency)


@pytest.mark.parametrize(
    ("operation", "known"),
    [(one, known) for one in OPERATIONS for known in ([False, True] if one.path_parameters else [False])],
    ids=lambda value: ("any path", "known path")[value] if isinstance(value, bool) else value.label,
)
def test_whatever_is_asked_the_answer_is_as_documented(serving, operation, known):
    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        context = serving()
        service = runner.run(context.__aenter__())
        if known and "tuning_id" in operation.path:
            runner.run(tune_once(service.client))
        if known and "schedule_id" in operation.path:
            runner.run(service.client.post("/v1/loops/heater/schedules", json={"set_points": [10.0, 20.0]}))

        count = EXAMPLES_OF_COMPUTATIONS if operation.path.endswith(COMPUTED) else EXAMPLES

        @hypothesis.settings(max_examples=count, deadline=None, derandomize=True, database=None)
        @hypothesis.given(
            case=operation.as_strategy(generation_mode=GenerationMode.POSITIVE)
            | operation.as_strategy(generation_mode=GenerationMode.NEGATIVE)
        )
        def ask(case):
            if known:
                case.path_parameters = {name: KNOWN[name] for name in case.path_parameters}
            response = runner.run(send(service, case))
            case.validate_response(response, checks=CHECKS)

        try:
            ask()
        finally:
            runner.run(context.__aexit__(None, None, None))


async def tune_once(client):
    """Leave one tuning behind that has ended with a result."""
    await client.post("/v1/loops/heater/tunings", json={"check": False})
    await client.get("/v1/tunings/tuning-1/events")


async def send(service, case):
    """Send a case, and end the tuning that it may have started."""
    asked = requests.Request(**case.as_transport_kwargs(base_url=str(service.client.base_url))).prepare()
    response = await service.client.request(asked.method, asked.url, headers=dict(asked.headers), content=asked.body)
    for loop in ("heater", "furnace"):
        if (tuning := service.manager.running(loop)) is not None:
            await service.client.post(f"/v1/tunings/{tuning.id}/abort")
            await asyncio.sleep(1.0)
    return response
