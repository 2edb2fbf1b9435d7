"""The client's calls against the API document that is committed: every operation, parameter, field and type."""

import inspect
import json
import types
import typing
from pathlib import Path

import pytest

from autotuner.client import AsyncClient, Client, calls, generate, requests

DOCUMENT = json.loads((Path(__file__).parents[2] / "docs" / "openapi.json").read_text(encoding="utf-8"))
OPERATIONS = {
    operation["operationId"]: (method, path, operation)
    for path, methods in DOCUMENT["paths"].items()
    for method, operation in methods.items()
}
ASKED = {
    "plan_tuning": requests.TuningStart,
    "start_tuning": requests.TuningStart,
    "compute_gains": requests.GainsChoice,
    "apply_gains": requests.GainsToApply,
    "identify": requests.IdentificationChoice,
    "diagnose": requests.DiagnosisChoice,
    "start_monitor": requests.MonitorStart,
    "start_schedule": requests.ScheduleStart,
    "combine_tunings": requests.TuningsToCombine,
}
"""What each call that takes a table of choices is asked by; the others take parameters of their own."""
ARGUMENTS = {
    "loop": "a/b c",
    "tuning_id": "x/y",
    "schedule_id": "x/y",
    "last": 3,
    "key": "key-12345",
    "csv": b"t,u,y\n",
    "force": True,
    "strict": True,
    "format": "json",
}


def call_of(name):
    """Return the call with every argument given."""
    function = getattr(calls, name)
    given = {parameter: ARGUMENTS.get(parameter, 7) for parameter in inspect.signature(function).parameters}
    table = dict.fromkeys(typing.get_type_hints(ASKED[name]), 7) if name in ASKED else {}
    given |= {parameter: table for parameter in ("body", "query") if parameter in given}
    return function(**given)


def resolved(schema):
    """Return a schema behind its reference, at one level."""
    if "$ref" in schema:
        return DOCUMENT["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    return schema


def types_of(schema):
    """Return the JSON types that a schema allows."""
    schema = resolved(schema)
    if "anyOf" in schema:
        return set().union(*map(types_of, schema["anyOf"]))
    if "type" not in schema:
        return {"string"} if "enum" in schema or "const" in schema else {"object"}
    return {schema["type"]} if isinstance(schema["type"], str) else set(schema["type"])


NAMES = {float: "number", int: "integer", str: "string", bool: "boolean", types.NoneType: "null"}


def types_of_hint(hint):
    if typing.get_origin(hint) is list:
        return {"array"}
    parts = typing.get_args(hint) if isinstance(hint, types.UnionType) or typing.get_origin(hint) else (hint,)
    return {NAMES.get(part, "object") for part in parts}


def test_every_operation_has_its_method_in_both_clients():
    for name in OPERATIONS:
        for client in (Client, AsyncClient):
            assert callable(getattr(client, name, None)), f"{client.__name__}.{name}"


def test_the_synchronous_client_is_the_one_that_is_generated():
    """`python -m autotuner.client.generate` writes it anew after a change of the asynchronous one."""
    assert generate.synchronous() == generate.TARGET.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", OPERATIONS)
def test_a_call_asks_what_the_document_says(name):
    method, path, operation = OPERATIONS[name]
    call = call_of(name)
    assert call.method.lower() == method
    filled = path.replace("{loop}", "a%2Fb%20c").replace("{tuning_id}", "x%2Fy").replace("{schedule_id}", "x%2Fy")
    assert call.path == filled
    parameters = operation.get("parameters", [])
    assert set(call.query) == {part["name"] for part in parameters if part["in"] == "query"}
    sent = {part["name"].lower() for part in parameters if part["in"] == "header"}
    assert set(call.headers) == sent


@pytest.mark.parametrize("name", OPERATIONS)
def test_a_body_is_what_the_document_says(name):
    content = OPERATIONS[name][2].get("requestBody", {}).get("content", {})
    call = call_of(name)
    assert (call.csv is not None) == ("text/csv" in content)
    if "application/json" in content:
        described = resolved(content["application/json"]["schema"])["properties"]
        assert set(call.body) == set(described)
    else:
        assert call.body is None


@pytest.mark.parametrize("name", ASKED)
def test_what_may_be_asked_has_the_types_of_the_document(name):
    operation = OPERATIONS[name][2]
    content = operation.get("requestBody", {}).get("content", {}).get("application/json")
    if content is not None:
        described = resolved(content["schema"])["properties"]
    else:
        described = {part["name"]: part["schema"] for part in operation["parameters"] if part["in"] == "query"}
    hints = typing.get_type_hints(ASKED[name])
    assert set(hints) == set(described)
    for field, hint in hints.items():
        assert types_of_hint(hint) == types_of(described[field]), field


def test_the_controller_beside_the_relay_has_the_fields_of_the_document():
    described = DOCUMENT["components"]["schemas"]["OnlineController"]["properties"]
    hints = typing.get_type_hints(requests.OnlineController)
    assert {field: types_of_hint(hint) for field, hint in hints.items()} == {
        field: types_of(schema) for field, schema in described.items()
    }


@pytest.mark.parametrize("name", OPERATIONS)
def test_an_answer_is_what_the_document_says(name):
    """The annotation of the method names the schema of the document; texts and streams are told by their kind."""
    answers = OPERATIONS[name][2]["responses"]
    content = next(row for status, row in answers.items() if status.startswith("2")).get("content", {})
    told = inspect.signature(getattr(Client, name)).return_annotation
    schema = content.get("application/json", {}).get("schema", {})
    if "text/event-stream" in content:
        assert told == "Iterator[dict[str, Any]]"
    elif "$ref" in schema and "text/csv" not in content:
        assert told.rpartition(".")[2] == schema["$ref"].rpartition("/")[2]
    elif schema.get("type") == "array":
        assert told == f"list[operation.{schema['items']['$ref'].rpartition('/')[2]}]"
    else:
        assert told == "str"
