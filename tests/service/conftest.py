"""Shared by the tests of the service: the whole application in memory, on simulated loops."""

import contextlib
import itertools
import json
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest
from pydantic import BaseModel

from autotuner.application.computing.compute_pool import InPlace
from autotuner.configuration import parse_configuration
from autotuner.ports import AUTO, OUTPUT
from autotuner.service.app import create_app
from autotuner.service.schemas.resources import Problem

DOCUMENT = Path(__file__).parents[2] / "docs" / "openapi.json"
"""The API document as committed, which a test keeps equal to the one that the service makes."""
HEATER = {
    "driver": "simulated",
    "sample_time_s": 0.1,
    "pv_unit": "degC",
    "output_unit": "%",
    "limits": {"output": [0.0, 100.0], "pv": [0.0, 250.0]},
    "relay": {"amplitude": 10.0},
    "device": {
        "plant": {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5},
        "output0": 40.0,
        "pv0": 80.0,
        "noise": 0.05,
        "seed": 1,
    },
}
FURNACE = {
    **HEATER,
    "sample_time_s": 5.0,
    "device": {
        **HEATER["device"],
        "plant": {"structure": "fopdt", "K": 2.0, "T": 600.0, "D": 90.0},
        "auto": True,
        # Does nothing, so that the mean of its output is where it began; the default gains would not hold this plant.
        "gains": {"kp": 0.0, "ti": 20.0, "td": 0.0},
    },
}
LOOPS = {"heater": HEATER, "furnace": FURNACE}


@pytest.fixture
def configure(tmp_path):
    """Return a function that makes a configuration of loops; two simulated ones by default."""

    def make(loops=LOOPS, **service):
        kept = {"data_directory": str(tmp_path / "data")}
        return parse_configuration({"service": kept | service, "loops": loops}, "test")

    return make


@pytest.fixture
def serving(configure):
    """Return an asynchronous context of the running service with a client: `app`, `client`, `manager`, `device`."""

    @contextlib.asynccontextmanager
    async def run(configuration=None, pool=None, *, raise_app_exceptions=True):
        numbers = itertools.count(1)
        app = create_app(configuration or configure(), pool or InPlace(), lambda: f"tuning-{next(numbers)}")
        transport = httpx.ASGITransport(app, raise_app_exceptions=raise_app_exceptions)
        async with (
            app.router.lifespan_context(app),
            httpx.AsyncClient(transport=transport, base_url="http://localhost:8321") as client,
        ):
            yield SimpleNamespace(app=app, client=client, manager=app.state.manager, device=Devices(app).state)

    return run


class Devices:
    """The simulated devices behind a service, seen from outside."""

    def __init__(self, app):
        self._backends = app.state.manager._backends

    async def state(self, loop):
        """Return output and mode that the device holds now."""
        backend = self._backends[loop]
        await backend.open()
        seen = await backend.read([OUTPUT, AUTO])
        return seen[OUTPUT], seen[AUTO]


def undescribed(told, place=""):
    """Return what a response tells beyond its description, at any depth."""
    if isinstance(told, list | tuple):
        return {
            name: value for i, part in enumerate(told) for name, value in undescribed(part, f"{place}[{i}]").items()
        }
    if not isinstance(told, BaseModel):
        return {}
    found = {f"{place}.{name}": value for name, value in (told.model_extra or {}).items()}
    for name in type(told).model_fields:
        found |= undescribed(getattr(told, name), f"{place}.{name}")
    return found


@pytest.fixture(name="undescribed")
def undescribed_fixture():
    return undescribed


@pytest.fixture
def check_problem():
    """Return a function that checks a response to be a problem of a status and a name, and returns it."""

    def check(response, status, name):
        assert response.status_code == status, response.text
        assert response.headers["content-type"] == "application/problem+json"
        problem = response.json()
        assert undescribed(Problem.model_validate(problem)) == {}
        assert problem["status"] == status
        assert problem["type"] == (name if name == "about:blank" else f"/v1/problems#{name}")
        assert problem["instance"] == response.request.url.path
        return problem

    return check


@pytest.fixture
def upload():
    """Return a function that posts a body piece by piece, as the server hands it over; None breaks it off."""

    async def post(app, path, pieces, **headers):
        pieces = iter(pieces)
        answers = []

        async def receive():
            piece = next(pieces)
            if piece is None:
                return {"type": "http.disconnect"}
            return {"type": "http.request", "body": piece, "more_body": True}

        async def send(message):
            answers.append(message)

        request = httpx.Request("POST", f"http://localhost:8321{path}", headers=headers)
        scope = {
            "type": "http",
            "method": "POST",
            "path": path,
            "root_path": "",
            "query_string": b"",
            "headers": [(name.lower(), value) for name, value in request.headers.raw],
        }
        await app(scope, receive, send)
        start, *body = answers
        content = b"".join(message["body"] for message in body)
        return httpx.Response(start["status"], headers=start["headers"], content=content, request=request)

    return post


def events_of(text):
    """Return the events of a server-sent stream as (id, event, data), by the rules of the HTML standard."""
    events, fields = [], {}
    for line in text.splitlines():
        if line.startswith(":"):
            continue
        if not line:
            if "data" in fields:
                events.append((int(fields["id"]), fields["event"], json.loads(fields["data"])))
            fields = {}
            continue
        name, _, value = line.partition(":")
        fields[name] = value.removeprefix(" ")
    return events


@pytest.fixture
def read_events():
    return events_of
