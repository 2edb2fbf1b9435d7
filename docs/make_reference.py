"""Make the pages of docs/reference from the code.

    python docs/make_reference.py

Invariant: what these pages say is written here and in the code, nowhere else; a test compares.
"""

from __future__ import annotations

import argparse
import ast
import json
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autotuner.commands.command_line import COMMANDS
from autotuner.commands.terminal.output import EXIT_CODES
from autotuner.control.devices.plugins import COMMANDS as PLUGINS
from autotuner.control.devices.plugins import announced
from autotuner.core.design import GOALS, rule_named, rule_names
from autotuner.core.diagnosis.findings.advice import REMEDIES, TELLS_APART
from autotuner.service.openapi import document
from autotuner.service.problems import PROBLEMS

if TYPE_CHECKING:
    from collections.abc import Iterator

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
REFERENCE = DOCS / "reference"
NOTE = "<!-- Made by `python docs/make_reference.py`; do not edit. -->\n"
FEW = 12
"""Most values of a field that are listed where it stands."""
ELSEWHERE = {
    "ambient": "disturbance",
    "measured_disturbance": "disturbance",
    "not_settled": "process",
    "nonlinear_stiffness": "process",
}
"""Places of effects whose object is made under a name that the recording gives."""
VERDICTS = ("refused", "aborted", "failed")

COMMANDS_HEAD = """# Commands

This page lists every command with its arguments. [Use the shell](../how-to/use-the-shell.md) has examples. Every
command has `--help`, and `autotuner --version` prints the version. Every message begins with `autotuner: ` and names
field, value and remedy.

| exit code | meaning |
| --- | --- |
| 0 | done |
| 1 | failed, with a reason on standard error |
| 2 | wrong usage, refused before any output moves |
"""
ENDPOINTS_HEAD = """# Endpoints

This page lists every endpoint with its parameters. [openapi.json](../openapi.json) has every field of every answer.
[REST](../rest.md) has an example of a tuning, and [Access](../access.md) the permissions.
"""
EFFECTS_HEAD = """# Effects

This page lists every effect that the diagnosis can name, with its place in the loop and its advice. Numbers in braces
are the reported sizes. [Read a diagnosis](../how-to/read-a-diagnosis.md) explains a result, and
[Effects](../effects.md) has the accuracy of the diagnosis.
"""
RULES_HEAD = """# Goals and rules

This page lists the goals and the tuning rules. A goal is a limit of the largest sensitivity.
[Choose a goal](../how-to/choose-a-goal.md) has advice.
"""
ERRORS_HEAD = """# Errors and verdicts

This page lists the errors of requests and commands, and the verdicts of operations.

## Errors

Over REST an error is a problem (RFC 9457) with this name at the end of its `type`. In the shell it is a message with an
exit code. Each names the refused value and a remedy.
"""
VERDICTS_HEAD = """## Verdicts

A tuning, an identification or a verification can end with these verdicts, other than `done`. A verdict is not an error:
the operation ran, and the message states why it has no result. `...` replaces numbers.
"""


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown; a row of cells each."""
    lines = [
        head,
        ["---"] * len(head),
        *([cell.replace("|", "\\|").replace("\n", " ") for cell in row] for row in rows),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


# -- the command line -------------------------------------------------------------------------------------------------


def commands() -> str:
    """Return the page of the commands."""
    plugins = {name: point for name, point in sorted(announced(PLUGINS).items()) if name not in COMMANDS}
    found = {name: import_module(f"autotuner.commands.{name}").command for name in COMMANDS}
    found |= {name: point.load() for name, point in plugins.items()}
    parts = [_command(name, command) for name, command in found.items()]
    return "\n".join([NOTE + COMMANDS_HEAD, *parts])


def _command(name: str, command: Any) -> str:
    parser = argparse.ArgumentParser(prog=name, add_help=False)
    command.configure(parser)
    return f"## autotuner {name}\n\n{command.help}\n\n" + _arguments(parser)


def _arguments(parser: argparse.ArgumentParser) -> str:
    rows, below = [], ""
    for action in parser._actions:  # noqa: SLF001 - argparse tells its arguments nowhere else
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            for word, sub in action.choices.items():
                below += f"\n### autotuner {parser.prog} {word}\n\n" + _arguments(sub)
        elif action.dest != "help":
            rows.append(
                [f"`{_shown(action)}`", (action.help or "") % vars(action) if action.help else "", _default(action)]
            )
    return (table(["argument", "meaning", "default"], rows) if rows else "") + below


def _shown(action: argparse.Action) -> str:
    value = action.metavar or (
        "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper()
    )
    value = " ".join(value) if isinstance(value, tuple) else str(value)
    if not action.option_strings:
        return value
    return ", ".join(action.option_strings) + ("" if action.nargs == 0 else f" {value}")


def _default(action: argparse.Action) -> str:
    if action.nargs == 0 or action.default is None or action.default == argparse.SUPPRESS:
        return "required" if action.required and action.option_strings else ""
    if isinstance(action.default, list | tuple):
        words = ["=".join(map(str, one)) if isinstance(one, tuple) else str(one) for one in action.default]
        return f"`{' '.join(words)}`" if words and None not in action.default else ""
    return f"`{action.default}`"


# -- REST -------------------------------------------------------------------------------------------------------------


def rest() -> str:
    """Return the page of the endpoints, from the API document."""
    told = json.loads(document())
    schemas = told["components"]["schemas"]
    parts = [
        _operation(method, path, operation, schemas)
        for path, methods in told["paths"].items()
        for method, operation in methods.items()
    ]
    return "\n".join([NOTE + ENDPOINTS_HEAD, *parts])


def _operation(method: str, path: str, operation: dict[str, Any], schemas: dict[str, Any]) -> str:
    given = [
        [f"`{one['name']}`", one["in"], _type(one["schema"]), one.get("description", "")]
        for one in operation.get("parameters", [])
    ]
    body = operation.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema", {})
    fields = _resolved(body, schemas).get("properties", {})
    given += [[f"`{name}`", "body", _type(one), one.get("description", "")] for name, one in fields.items()]
    answers = ", ".join(operation["responses"])
    text = f"## {method.upper()} {path}\n\n{operation.get('description', '')}\n\n"
    return text + (table(["name", "in", "type", "meaning"], given) + "\n" if given else "") + f"Answers: {answers}.\n"


def _resolved(schema: dict[str, Any], schemas: dict[str, Any]) -> dict[str, Any]:
    for one in (schema, *schema.get("allOf", []), *schema.get("anyOf", [])):
        if "$ref" in one:
            return schemas[one["$ref"].rpartition("/")[2]]
    return schema


def _type(schema: dict[str, Any]) -> str:
    if "$ref" in schema:
        return schema["$ref"].rpartition("/")[2]
    if len(schema.get("enum", ())) > FEW:
        return "one of the [rules](rules.md)"
    if "enum" in schema:
        return " or ".join(f"`{value}`" for value in schema["enum"])
    if "anyOf" in schema:
        return ", ".join(_type(one) for one in schema["anyOf"] if one.get("type") != "null")
    return schema.get("type", "any")


# -- effects, rules, errors -------------------------------------------------------------------------------------------


def effects() -> str:
    """Return the page of the effects that the diagnosis knows."""
    places = ELSEWHERE | dict(_places(set(REMEDIES)))
    rows = [[f"`{name}`", places.get(name, "sensor"), text] for name, text in REMEDIES.items()]
    apart = [[", ".join(f"`{name}`" for name in sorted(names)), text] for names, text in TELLS_APART.items()]
    return (
        f"{NOTE}{EFFECTS_HEAD}\n"
        + table(["name", "place", "advice"], rows)
        + "\nSome records cannot distinguish two effects. These records would:\n\n"
        + table(["effects", "record that distinguishes them"], apart)
    )


def _places(names: set[str]) -> Iterator[tuple[str, str]]:
    """Yield where each effect sits, as its object in the catalogue says."""
    for path in sorted((ROOT / "autotuner/core/diagnosis").rglob("*.py")):
        for call in _calls(path):
            words = [one.value for one in call.args if isinstance(one, ast.Constant) and one.value in names]
            arguments = [*call.args, *(keyword.value for keyword in call.keywords)]
            place = [
                one.attr for one in arguments if isinstance(one, ast.Attribute) and ast.unparse(one.value) == "Place"
            ]
            if words and place:
                yield words[0], place[0].lower()


def _calls(path: Path) -> list[ast.Call]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call)]


def rules() -> str:
    """Return the page of goals and tuning rules."""
    goals = [[f"`{name}`", f"{limit:g}"] for name, limit in GOALS.items()]
    rows = []
    for name in rule_names():
        rule = rule_named(name)
        valid = "" if rule.valid is None else f"{rule.valid.lower:g} to {rule.valid.upper:g} of {rule.valid.quantity}"
        kinds = ", ".join(kind.__name__ for kind in rule.formulas)
        rows.append([f"`{name}`", rule.title, rule.controller, kinds, valid, rule.source])
    return (
        f"{NOTE}{RULES_HEAD}\n"
        + table(["goal", "Ms and Mt at most"], goals)
        + '\nRules from the literature, by name (`--rule NAME`, `"rule"` in requests):\n\n'
        + table(["name", "title", "controller", "model", "recommended range", "source"], rows)
    )


def errors() -> str:
    """Return the page of errors and verdicts."""
    rows = [
        [f"`{row.name}`", str(row.status), row.title, _first_line(kind), _exit_code(kind, EXIT_CODES)]
        for kind, row in PROBLEMS.items()
    ]
    verdicts = [[f"`{code}`", outcome, text] for code, (outcome, text) in sorted(_verdicts().items())]
    return (
        f"{NOTE}{ERRORS_HEAD}\n"
        + table(["name", "status", "title", "meaning", "exit code"], rows)
        + f"\n{VERDICTS_HEAD}\n"
        + table(["code", "outcome", "message"], verdicts)
    )


def _first_line(kind: type) -> str:
    return (kind.__doc__ or "").strip().splitlines()[0]


def _exit_code(kind: type, codes: dict[Any, int]) -> str:
    return str(next(code for base, code in codes.items() if issubclass(kind, base)))


def _verdicts() -> dict[str, tuple[str, str]]:
    """Return outcome and message by code, as the code writes them."""
    found: dict[str, tuple[str, str]] = {}
    for path in sorted((ROOT / "autotuner").rglob("*.py")):
        for call in _calls(path):
            name = call.func.id if isinstance(call.func, ast.Name) else ""
            if name in VERDICTS and len(call.args) > 1 and isinstance(call.args[0], ast.Constant):
                found.setdefault(call.args[0].value, (name, _message(call.args[1])))
    return found


def _message(node: ast.expr) -> str:
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(_message(part) if isinstance(part, ast.Constant) else "..." for part in node.values)
    return "..."


PAGES = {"commands.md": commands, "rest.md": rest, "effects.md": effects, "rules.md": rules, "errors.md": errors}
"""The pages of docs/reference and what makes them."""


if __name__ == "__main__":
    for name, make in PAGES.items():
        (REFERENCE / name).write_text(make(), encoding="utf-8")
