"""Whatever is asked of the API: thousands of cases made from its document, sent to the whole application in memory.

    python benchmarks/safety/requests/api_cases.py [--cases N] [--seed N]

For every operation, cases with what the document allows and with what it does not; paths with names that exist and with
any. Each answer must be one that the document describes, in status, headers, kind and content, and none a 5xx other
than those it describes. Time is virtual, a tuning that a case starts is ended again. Prints the number of cases by
operation, and every answer that breaks the document.
"""

import argparse
import asyncio
import itertools
import json
import tempfile
from collections import Counter

import async_solipsism
import httpx
import hypothesis
import requests
import schemathesis
from schemathesis import checks
from schemathesis.generation import GenerationMode

from autotuner.application.computing.compute_pool import InPlace
from autotuner.configuration import parse_configuration
from autotuner.service.app import create_app
from autotuner.service.openapi import document

LOOP = {
    "driver": "simulated",
    "sample_time_s": 0.5,
    "limits": {"output": [0.0, 100.0], "pv": [0.0, 250.0]},
    "relay": {"amplitude": 10.0, "check": False},
    "gains": {"form": "ideal"},
    "device": {
        "plant": {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5},
        "output0": 40.0,
        "pv0": 80.0,
        "noise": 0.05,
    },
}
CHECKED = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "negative_data_rejection",
)
MODES = (GenerationMode.POSITIVE, GenerationMode.NEGATIVE)


class Run:
    """One application for all cases of an operation."""

    def __init__(self, folder):
        numbers = itertools.count(1)
        told = {"service": {"data_directory": folder, "requests_per_s": 1e9}, "loops": {"heater": LOOP}}
        self.app = create_app(parse_configuration(told, "bench"), InPlace(), lambda: f"tuning-{next(numbers)}")
        self.known = {"loop": "heater", "tuning_id": "tuning-1"}
        self.client = httpx.AsyncClient(transport=httpx.ASGITransport(self.app), base_url="http://localhost:8321")

    async def begin(self, path):
        """Start; what the path of an operation needs is made."""
        self._life = self.app.router.lifespan_context(self.app)
        await self._life.__aenter__()
        if "{tuning_id}" in path:
            await self.client.post("/v1/loops/heater/tunings", json={})
            await self.client.get("/v1/tunings/tuning-1/events")
        if "{schedule_id}" in path:
            started = await self.client.post("/v1/loops/heater/schedules", json={"set_points": [80.0, 85.0]})
            self.known["schedule_id"] = started.json()["id"]

    async def end(self):
        await self.client.aclose()
        await self._life.__aexit__(None, None, None)

    async def send(self, case):
        asked = requests.Request(**case.as_transport_kwargs(base_url=str(self.client.base_url))).prepare()
        answer = await self.client.request(asked.method, asked.url, headers=dict(asked.headers), content=asked.body)
        for loop in (await self.client.get("/v1/loops")).json()["loops"]:
            if loop["tuning_id"] is not None:
                await self.client.post(f"/v1/tunings/{loop['tuning_id']}/abort")
                await asyncio.sleep(5.0)
        return answer


def cases(operation, mode, *, known, most, seed):
    """Send so many cases of an operation; return statuses and what broke the document."""
    statuses, broken = Counter(), []
    with tempfile.TemporaryDirectory() as folder, asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        run = Run(folder)
        runner.run(run.begin(operation.path if known else ""))

        @hypothesis.seed(seed)
        @hypothesis.settings(
            max_examples=most,
            deadline=None,
            database=None,
            suppress_health_check=list(hypothesis.HealthCheck),
            phases=[hypothesis.Phase.generate],
        )
        @hypothesis.given(case=operation.as_strategy(generation_mode=mode))
        def ask(case):
            if known:
                case.path_parameters = {name: run.known[name] for name in case.path_parameters}
            answer = runner.run(run.send(case))
            statuses[int(answer.status_code)] += 1
            try:
                case.validate_response(answer, checks=checks.CHECKS.get_by_names(CHECKED))
            except (AssertionError, ExceptionGroup) as error:
                broken.append(f"{operation.label} {answer.status_code}: {error}")

        try:
            ask()
        except hypothesis.errors.Unsatisfiable:  # nothing of this kind can be made of it
            pass
        finally:
            runner.run(run.end())
    return statuses, broken


def varies(operation):
    """Return whether cases of a known path differ in anything."""
    return bool(operation.query or operation.headers or operation.body)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=5000, help="in all (5000)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="operations with this in their names")
    args = parser.parse_args()
    schema = schemathesis.openapi.from_dict(json.loads(document()))
    operations = [one.ok() for one in schema.get_all_operations() if args.only in one.ok().label]
    kinds = [
        (one, mode, known)
        for one in operations
        for mode in MODES
        for known in ([False, True] if one.path_parameters else [False])
    ]
    kinds.sort(key=lambda kind: kind[0].method != "get")  # these have few cases and leave theirs to the others
    total, broken = Counter(), []
    for turn in itertools.count():  # again, with other seeds, where some kinds had fewer cases than their share
        for number, (operation, mode, known) in enumerate(kinds):
            left = -(-(args.cases - total.total()) // (len(kinds) - number))
            each = max(1, left) if not known or varies(operation) else 1
            statuses, found = cases(operation, mode, known=known, most=each, seed=args.seed + turn)
            total += statuses
            broken += found
            told = ", ".join(f"{status}: {count}" for status, count in sorted(statuses.items()))
            print(f"{operation.label:50} {mode.value:9} {'known' if known else 'any':6} {told}", flush=True)
        kinds = [kind for kind in kinds if kind[0].method == "post" and varies(kind[0])][::-1]
        if total.total() >= args.cases or not kinds:
            break
    print(f"{total.total()} cases of {len(operations)} operations; by status {dict(sorted(total.items()))}")
    print(f"{len(broken)} broke the document")
    for text in broken:
        print(text)
    raise SystemExit(1 if broken else 0)


if __name__ == "__main__":
    main()
