"""Being operated: readiness with each loop's link, numbers for Prometheus, log lines for programs."""

import asyncio
import json
import logging
import re
from types import SimpleNamespace

import pytest
from prometheus_client.parser import text_string_to_metric_families

from autotuner.application.tuning_run import TuningRun
from autotuner.control.reporting.event_log import log_event
from autotuner.control.reporting.events import Ended, OutputRestored, OutputUnknown, PhaseChanged, SampleTaken
from autotuner.core.verdict import failed
from autotuner.errors import LinkError
from autotuner.service.operations.logs import JsonLines
from autotuner.service.operations.metrics import Metrics
from autotuner.service.schemas.operation import Readiness


async def silent(*_):
    raise LinkError("no answer", remedy="Check the cable.")


def numbers(text):
    """Return every number by its name and labels."""
    return {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


@pytest.mark.virtual_time
async def test_readiness_tells_each_link(serving, undescribed, check_problem):
    async with serving() as service:
        first = Readiness.model_validate((await service.client.get("/readyz")).json())
        assert [(link.loop, link.link) for link in first.loops] == [("heater", "unknown"), ("furnace", "unknown")]
        await asyncio.sleep(1.0)
        second = (await service.client.get("/readyz")).json()
        assert [link["link"] for link in second["loops"]] == ["up", "up"]
        service.manager._backends["heater"].open = silent
        await asyncio.sleep(10.0)
        await service.client.get("/readyz")
        await asyncio.sleep(1.0)
        third = Readiness.model_validate((await service.client.get("/readyz")).json())
        assert (third.status, third.loops[0].link, third.loops[1].link) == ("degraded", "down", "up")
        assert "Check the cable" in third.loops[0].error
        assert undescribed(third) == {}
        problem = check_problem(await service.client.get("/readyz?loop=heater"), 502, "device-error")
        assert problem["field"] == "heater"
        assert problem["detail"] == "heater: does not answer: no answer. Check the cable. Ask again when that is done."
        assert (await service.client.get("/readyz?loop=furnace")).status_code == 200
        check_problem(await service.client.get("/readyz?loop=none"), 404, "unknown-loop")


@pytest.mark.virtual_time
async def test_the_link_of_a_loop_being_tuned_is_as_its_last_sample(serving):
    async with serving() as service:
        tuning_id = (await service.client.post("/v1/loops/heater/tunings")).json()["id"]
        await asyncio.sleep(5.0)
        link = (await service.client.get("/readyz?loop=heater")).json()["loops"][0]
        assert (link["tuning_id"], link["link"]) == (tuning_id, "up")
        backend = service.manager._backends["heater"]
        reading, backend.read = backend.read, silent
        await asyncio.sleep(0.3)
        assert (await service.client.get("/readyz?loop=heater")).status_code == 502
        backend.read = reading
        await asyncio.sleep(5.0)
        assert (await service.client.get("/readyz?loop=heater")).status_code == 200
        told = numbers((await service.client.get("/metrics")).text)
        assert told[("autotuner_link_errors_total", ("loop", "heater"))] >= 1.0


@pytest.mark.virtual_time
async def test_numbers_are_those_of_the_events(serving):
    async with serving() as service:
        tuning = service.manager.tuning((await service.client.post("/v1/loops/heater/tunings")).json()["id"])
        await asyncio.sleep(20.0)
        answer = await service.client.get("/metrics")
        assert answer.headers["content-type"].startswith("text/plain; version=")
        told = numbers(answer.text)
        loop = ("loop", "heater")
        assert told[("autotuner_samples_total", loop)] == len(tuning.samples)
        assert told[("autotuner_sample_lateness_seconds_count", loop)] == len(tuning.samples)
        assert told[("autotuner_tuning_running", loop)] == 1.0
        assert told[("autotuner_tuning_running", ("loop", "furnace"))] == 0.0
        assert told[("autotuner_link_up", loop)] == told[("autotuner_store_up",)] == 1.0
        await service.client.post(f"/v1/tunings/{tuning.id}/abort")
        async for _ in tuning.follow():
            pass
        await asyncio.sleep(1.0)
        told = numbers((await service.client.get("/metrics")).text)
        assert told[("autotuner_samples_total", loop)] == len(tuning.samples)
        entered = [event.phase for event in tuning.events if isinstance(event, PhaseChanged)]
        for phase in entered:
            assert told[("autotuner_phases_total", loop, ("phase", phase))] == entered.count(phase)
        ended = ("autotuner_tunings_total", ("code", "requested"), loop, ("outcome", "aborted"))
        assert told[ended] == 1.0
        assert told[("autotuner_output_unknown", loop)] == 0.0
        assert told[("autotuner_tuning_running", loop)] == 0.0


@pytest.mark.virtual_time
async def test_asking_twice_counts_once(serving):
    async with serving() as service:
        await service.client.post("/v1/loops/heater/tunings")
        await asyncio.sleep(20.0)
        first = numbers((await service.client.get("/metrics")).text)
        second = numbers((await service.client.get("/metrics")).text)
    key = ("autotuner_samples_total", ("loop", "heater"))
    assert first[key] == second[key] > 100.0


UNKNOWN = [OutputUnknown(9.0, 1, "no answer"), Ended(9.5, "failed", "output_unknown", "", "")]
DONE = [OutputRestored(9.0, 40.0, True), Ended(9.5, "done", "identified", "", "")]


def tuning_with(events, identifier, kept=None):
    return SimpleNamespace(id=identifier, loop="a", kept=kept, events=events, ended_before=False, verification=None)


def unknown_output(*tunings):
    """Return what is told of the output of a loop whose tunings, the oldest first, had these events."""
    metrics = Metrics()
    metrics.count(tuning_with(events, str(k)) for k, events in enumerate(tunings))
    return numbers(metrics.text().decode())[("autotuner_output_unknown", ("loop", "a"))]


def test_an_output_is_unknown_as_the_last_tuning_left_it():
    assert unknown_output(DONE, UNKNOWN) == 1.0
    assert unknown_output(UNKNOWN, DONE) == 0.0


@pytest.mark.virtual_time
async def test_a_first_scrape_after_several_tunings_tells_of_the_last(serving):
    async with serving() as service:
        for name, events in (("first", DONE), ("second", UNKNOWN)):
            verdict = failed("gone", "it is gone", "Look.")
            service.manager.tunings[name] = TuningRun(name, "heater", None, verdict=verdict, events=events)
        told = numbers((await service.client.get("/metrics")).text)
    assert told[("autotuner_output_unknown", ("loop", "heater"))] == 1.0


def test_a_tuning_that_is_taken_up_again_is_counted_from_there():
    metrics, kept = Metrics(), SimpleNamespace(samples=[1, 2])
    sample = SampleTaken(1.0, 80.0, 40.0, 50.0, 0.0, 1.0)
    first = tuning_with([sample, sample, *UNKNOWN], "x")
    metrics.count([first])
    metrics.count([tuning_with([sample, sample, *DONE], "x", kept)])
    told = numbers(metrics.text().decode())
    assert told[("autotuner_output_unknown", ("loop", "a"))] == 0.0
    assert told[("autotuner_samples_total", ("loop", "a"))] == 2.0


@pytest.mark.virtual_time
async def test_a_link_is_down_while_a_loop_cannot_be_given_back(serving):
    async with serving() as service:
        tuning_id = (await service.client.post("/v1/loops/heater/tunings")).json()["id"]
        await asyncio.sleep(20.0)
        backend = service.manager._backends["heater"]
        writing, backend.write = backend.write, silent
        await service.client.post(f"/v1/tunings/{tuning_id}/abort")
        await asyncio.sleep(1.0)
        assert (await service.client.get("/readyz?loop=heater")).status_code == 502
        assert (
            numbers((await service.client.get("/metrics")).text)[("autotuner_output_unknown", ("loop", "heater"))]
            == 1.0
        )
        backend.write = writing
        await asyncio.sleep(5.0)
        assert (await service.client.get("/readyz?loop=heater")).status_code == 200


@pytest.mark.virtual_time
async def test_every_number_is_described(serving, pytestconfig):
    page = (pytestconfig.rootpath / "docs" / "operating.md").read_text(encoding="utf-8")
    async with serving() as service:
        text = (await service.client.get("/metrics")).text
    ours = {name for name in re.findall(r"^# TYPE (\w+)", text, re.MULTILINE) if name.startswith("autotuner")}
    assert {name for name in ours if name not in page} == set()


def test_a_log_line_tells_what_it_is_about(caplog):
    caplog.set_level(logging.INFO)
    log_event("3f2a", "TIC-101", PhaseChanged(1.5, "relay"))
    told = json.loads(JsonLines().format(caplog.records[-1]))
    assert (told["tuning"], told["loop"], told["t_s"], told["level"]) == ("3f2a", "TIC-101", 1.5, "INFO")
    assert told["message"].endswith("phase relay")
    assert told["at"].endswith("+00:00")


def test_a_trace_stays_on_its_line(caplog):
    try:
        int("line one\nline two")
    except ValueError:
        logging.getLogger("x").exception("it failed")
    line = JsonLines().format(caplog.records[-1])
    assert "\n" not in line
    assert "ValueError" in json.loads(line)["trace"]
