"""Parts of the OpenAPI document that the framework does not derive from the endpoints: problems and live events."""

from __future__ import annotations

import inspect
import typing
from typing import Any

from pydantic import TypeAdapter

from autotuner.control.reporting.events import Event
from autotuner.control.verification.verification_events import VerificationEvent
from autotuner.service.events.live import PATH, VERIFICATION_PATH
from autotuner.service.schemas.resources import Problem

TEXT = {"type": "string"}
REFERENCE = "#/components/schemas/{}"


def described(document: dict[str, Any]) -> dict[str, Any]:
    """Add the problem, and the events of a tuning and of a verification, to an OpenAPI document, and return it."""
    document["components"]["schemas"] |= {"Problem": Problem.model_json_schema()}
    for path, name, union in ((PATH, "Event", Event), (VERIFICATION_PATH, "VerificationEvent", VerificationEvent)):
        document["components"]["schemas"] |= _union_of(name, union)
        data = {
            "type": "string",
            "contentMediaType": "application/json",
            "contentSchema": {"$ref": REFERENCE.format(name)},
        }
        fields = {"data": data, "event": TEXT, "id": TEXT, "retry": {"type": "integer", "minimum": 0}}
        content = document["paths"][path]["get"]["responses"]["200"]["content"]
        content["text/event-stream"] = {"itemSchema": {"type": "object", "properties": fields}}
    return document


def _union_of(name: str, union: Any) -> dict[str, Any]:
    """Return the schemas of a tagged union and of its kinds, by name."""
    kinds = {kind.__name__: _event_schema(kind) for kind in typing.get_args(union)}
    tags = {schema["properties"]["type"]["const"]: REFERENCE.format(kind) for kind, schema in kinds.items()}
    whole = {
        "description": "The data of one server-sent event.",
        "oneOf": [{"$ref": reference} for reference in tags.values()],
        "discriminator": {"propertyName": "type", "mapping": tags},
    }
    return {name: whole, **kinds}


def _event_schema(kind: Any) -> dict[str, Any]:
    """Return the schema of an event's `to_dict`: the tag, and numbers that are null when not finite."""
    properties = _nullable(TypeAdapter(kind).json_schema()["properties"])
    tag = {"type": "string", "const": kind.type}
    return {
        "title": kind.__name__,
        "description": inspect.getdoc(kind),
        "type": "object",
        "properties": {"type": tag, **properties},
        "required": ["type", *properties],
        "additionalProperties": False,
    }


def _nullable(schema: Any) -> Any:
    """Return a schema in which every number may be null, at any depth."""
    if not isinstance(schema, dict):
        return schema
    parts = {name: _nullable(part) for name, part in schema.items()}
    return {**parts, "type": ["number", "null"]} if parts.get("type") == "number" else parts
