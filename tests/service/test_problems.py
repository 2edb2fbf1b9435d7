"""Every refusal is a problem that names what was refused and what to do."""

import inspect

import pytest

from autotuner import errors
from autotuner.service import errors as service_errors
from autotuner.service.problems import PROBLEMS, UNEXPECTED, row_of

pytestmark = pytest.mark.virtual_time

START = "/v1/loops/heater/tunings"

ALL_ERRORS = [
    kind
    for module in (errors, service_errors)
    for kind in vars(module).values()
    if inspect.isclass(kind) and issubclass(kind, errors.AutotunerError) and kind.__module__ == module.__name__
]
NEVER_IN_A_REQUEST = {errors.AutotunerError, service_errors.RequestError, service_errors.ListenError}


@pytest.mark.parametrize("kind", ALL_ERRORS, ids=lambda kind: kind.__name__)
def test_every_error_has_a_row(kind):
    row = row_of(kind.__new__(kind))
    assert (row is UNEXPECTED) == (kind in NEVER_IN_A_REQUEST)


def test_no_builtin_exception_has_a_row_and_names_are_unique():
    assert all(issubclass(kind, errors.AutotunerError) for kind in PROBLEMS)
    assert len({row.name for row in PROBLEMS.values()}) == len(PROBLEMS)
    assert all(400 <= row.status < 600 for row in PROBLEMS.values())


@pytest.mark.parametrize(
    ("method", "path", "name"),
    [
        ("GET", "/v1/loops/kiln", "unknown-loop"),
        ("POST", "/v1/loops/kiln/tunings", "unknown-loop"),
        ("GET", "/v1/tunings/none", "unknown-tuning"),
        ("GET", "/v1/tunings/none/events", "unknown-tuning"),
        ("GET", "/v1/tunings/none/recording", "unknown-tuning"),
        ("POST", "/v1/tunings/none/abort", "unknown-tuning"),
        ("POST", "/v1/tunings/none/gains", "unknown-tuning"),
    ],
)
async def test_what_is_not_there(serving, check_problem, method, path, name):
    async with serving() as service:
        problem = check_problem(await service.client.request(method, path), 404, name)
    assert problem["remedy"]
    assert problem["value"] in {"'kiln'", "'none'"}


async def test_unknown_loops_are_told_which_there_are(serving, check_problem):
    async with serving() as service:
        problem = check_problem(await service.client.get("/v1/loops/kiln"), 404, "unknown-loop")
    assert problem["remedy"] == "Use one of heater, furnace."


async def test_paths_and_methods_that_are_not_there(serving, check_problem):
    async with serving() as service:
        check_problem(await service.client.get("/v2/loops"), 404, "about:blank")
        answer = await service.client.delete("/v1/loops")
        check_problem(answer, 405, "about:blank")
        assert answer.headers["allow"] == "GET"


@pytest.mark.parametrize(
    ("body", "field", "value"),
    [
        ({"amplitude": -1.0}, "amplitude", "-1.0"),
        ({"amplitude": 0}, "amplitude", "0"),
        ({"amplitude": "ten"}, "amplitude", "'ten'"),
        ({"amplitude": "10"}, "amplitude", "'10'"),
        ({"amplitude": True}, "amplitude", "True"),
        ({"amplitude": [10.0]}, "amplitude", "[10.0]"),
        ({"amplitude": 60.0}, "amplitude", "60.0"),
        ({"ratio": 0.5}, "ratio", "0.5"),
        ({"ratio": 6.0}, "ratio", "6.0"),
        ({"hysteresis": -0.1}, "hysteresis", "-0.1"),
        ({"quiet_s": 0.0}, "quiet_s", "0.0"),
        ({"min_periods": 1}, "min_periods", "1"),
        ({"min_periods": 3.5}, "min_periods", "3.5"),
        ({"min_periods": 13}, "min_periods", "13"),
        ({"max_periods": 10**9}, "max_periods", "1000000000"),
        ({"accuracy": 2.0}, "accuracy", "2.0"),
        ({"check": "no"}, "check", "'no'"),
        ({"time_limit_s": 0.0}, "time_limit_s", "0.0"),
        ({"online": {"Kp": -1.0}}, "online.Kp", "-1.0"),
        ({"online": {"Kp": 1.0, "Ti": 0.0}}, "online.Ti", "0.0"),
        ({"online": {"Kp": 1.0, "Ki": 1.0}}, "online.Ki", "1.0"),
        ({"structure": "magic"}, "structure", "'magic'"),
        ({"goal": "perfect"}, "goal", "'perfect'"),
        ({"rule": "Simc PI"}, "rule", "'Simc PI'"),
        ({"amplitud": 10.0}, "amplitud", "10.0"),
    ],
)
async def test_a_value_that_cannot_work(serving, check_problem, body, field, value):
    async with serving() as service:
        problem = check_problem(await service.client.post(START, json=body), 422, "unusable-value")
        assert service.manager.tunings == {}
    assert (problem["field"], problem["value"]) == (field, value)
    assert problem["remedy"] != "See /openapi.json for what is accepted."


async def test_every_wrong_value_is_listed(serving, check_problem):
    async with serving() as service:
        answer = await service.client.post(START, json={"amplitude": -1.0, "goal": "perfect"})
        problem = check_problem(answer, 422, "unusable-value")
    assert {error["field"]: error["remedy"] for error in problem["errors"]} == {
        "amplitude": "Give more than 0.0.",
        "goal": "Use one of 'calm', 'balanced' or 'brisk'.",
    }


@pytest.mark.parametrize(
    ("content", "kind", "status", "name"),
    [
        (b"{", "application/json", 422, "unusable-value"),
        (b'{"goal": "\xff"}', "application/json", 400, "about:blank"),
        (b"[" * 60_000, "application/json", 400, "about:blank"),
        (b'{"amplitude": NaN}', "application/json", 422, "unusable-value"),
        (b'{"amplitude": 1e999}', "application/json", 422, "unusable-value"),
        (b'{"min_periods": ' + b"9" * 5000 + b"}", "application/json", 400, "about:blank"),
        (b"[]", "application/json", 422, "unusable-value"),
        (b"amplitude=10", "application/x-www-form-urlencoded", 422, "unusable-value"),
        (b'{"amplitude": 10}', "text/plain", 422, "unusable-value"),
    ],
    ids=lambda value: value[:20] if isinstance(value, bytes) else None,
)
async def test_a_body_that_is_none(serving, check_problem, content, kind, status, name):
    async with serving() as service:
        answer = await service.client.post(START, content=content, headers={"Content-Type": kind})
        problem = check_problem(answer, status, name)
        assert service.manager.tunings == {}
    assert problem["remedy"]
    assert len(answer.content) < 1000


async def test_a_failure_of_the_program_tells_nothing_of_the_inside(serving, check_problem, monkeypatch):
    async with serving(raise_app_exceptions=False) as service:
        monkeypatch.setattr(type(service.manager), "holders", lambda *_: 1 / 0)
        problem = check_problem(await service.client.get("/v1/loops"), 500, "internal-error")
    assert "division" not in str(problem)


async def test_a_failure_of_the_program_reaches_the_log_of_the_server(serving, monkeypatch):
    async with serving() as service:
        monkeypatch.setattr(type(service.manager), "holders", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            await service.client.get("/v1/loops")


async def test_the_type_of_a_problem_can_be_looked_up(serving, check_problem):
    async with serving() as service:
        problem = check_problem(await service.client.get("/v1/loops/kiln"), 404, "unknown-loop")
        path, _, _ = problem["type"].partition("#")
        kinds = (await service.client.get(path)).json()
    assert {"type": problem["type"], "title": problem["title"], "status": 404} in kinds
