"""Uploaded recordings: identified, or refused with line, column and remedy."""

import asyncio
import itertools
from dataclasses import dataclass, field

import numpy as np
import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.configuration import ServiceTable
from autotuner.service.computations import identify_csv
from autotuner.service.operations.compute_queue import UPLOADS_OF_A_CLIENT

pytestmark = pytest.mark.virtual_time

PATH = "/v1/identifications"
CSV = {"Content-Type": "text/csv"}


@pytest.fixture(scope="module")
def step_test():
    """A step of 10 on K = 2, T = 10 s, D = 1.5 s, sampled every 0.1 s, by its closed form."""
    t = np.arange(0.0, 60.0, 0.1)
    output = np.where(t < 5.0, 40.0, 50.0)
    since = np.clip(t - 6.5, 0.0, None)
    pv = 80.0 + 20.0 * (1.0 - np.exp(-since / 10.0))
    return t, output, pv


def text_of(columns, header="t,u,y"):
    return (
        "\n".join([header, *(",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))]) + "\n"
    )


async def test_a_recording_is_identified(serving, step_test):
    async with serving() as service:
        answer = await service.client.post(
            f"{PATH}?structure=fopdt&goal=brisk", content=text_of(step_test), headers=CSV
        )
    assert answer.status_code == 200, answer.text
    told = answer.json()
    assert told["structure"] == "fopdt"
    assert told["model"] == {
        name: pytest.approx(value, rel=0.02) for name, value in {"K": 2, "T": 10, "D": 1.5}.items()
    }
    assert told["tuning"]["goal"] == "brisk"
    assert told["gains"] == told["tuning"]["gains"]
    assert told["samples"] == 600
    assert told["duration_s"] == pytest.approx(59.9)


async def test_columns_are_chosen_by_title_or_number(serving, step_test):
    t, output, pv = step_test
    header = "when,valve,other,level"
    content = text_of((t, output, -pv, pv), header)
    async with serving() as service:
        titled = await service.client.post(
            f"{PATH}?structure=fopdt&t_column=when&output_column=valve&pv_column=level", content=content, headers=CSV
        )
        numbered = await service.client.post(
            f"{PATH}?structure=fopdt&t_column=1&output_column=2&pv_column=4", content=content, headers=CSV
        )
        plain = await service.client.post(f"{PATH}?structure=fopdt", content=text_of(step_test), headers=CSV)
    assert titled.status_code == 200, titled.text
    assert titled.json() == numbered.json() == plain.json()


@pytest.mark.long  # repairs are in tests/core
async def test_a_repair_is_told(serving, step_test):
    lines = text_of(step_test).splitlines()
    lines[20] = lines[20].rpartition(",")[0] + ","
    async with serving() as service:
        answer = await service.client.post(f"{PATH}?structure=fopdt", content="\ufeff" + "\n".join(lines), headers=CSV)
    assert answer.json()["notes"] == ["recording: 1 rows without a usable output or PV were left out"]


@pytest.mark.parametrize(
    ("content", "field"),
    [
        (b"", "recording"),
        (b"t,u,y\n", "recording"),
        (b"t,u\n0,1\n1,1\n", "recording, line 1"),
        (b"t,u,y\n0,1,1\n1,one,1\n", "recording, line 3, column u"),
        (b"t,u,y\n0,1,1\n1,1\n", "recording, line 3"),
        (b"t,u,y\n0,1,1\n2,1,1\n1,1,1\n", "recording, line 4, column t"),
        (b"t,u,y\nnan,1,1\n1,1,1\n", "recording, line 2, column t"),
        (b"t,u,y\n0,nan,1\n1,nan,1\n", "t"),
        (b"\x1f\x8b\x08\x00\xff", "recording"),
        ("t,u,y\n0,1,1\n".encode("utf-16"), "recording"),
    ],
    ids=lambda value: None if isinstance(value, str) else repr(value[:24]),
)
async def test_a_recording_that_cannot_be_used(serving, check_problem, content, field):
    async with serving() as service:
        problem = check_problem(
            await service.client.post(PATH, content=content, headers=CSV), 422, "unusable-recording"
        )
    assert problem["field"] == field
    assert problem["remedy"]


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("structure=magic", "structure"),
        ("known_gain=nan", "known_gain"),
        ("known_gain=much", "known_gain"),
        ("goal=perfect", "goal"),
        ("rule=none", "rule"),
        ("colour=red", "colour"),
    ],
)
async def test_a_choice_that_cannot_be_used(serving, check_problem, step_test, query, field):
    async with serving() as service:
        answer = await service.client.post(f"{PATH}?{query}", content=text_of(step_test), headers=CSV)
    assert check_problem(answer, 422, "unusable-value")["field"] == field


async def test_a_column_that_is_not_there(serving, check_problem, step_test):
    async with serving() as service:
        answer = await service.client.post(f"{PATH}?pv_column=level", content=text_of(step_test), headers=CSV)
    problem = check_problem(answer, 422, "unusable-recording")
    assert problem["value"] == "'t,u,y'"


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Content-Type": "application/json"},
        {"Content-Type": "multipart/form-data; boundary=x"},
        {"Content-Type": "text/csv", "Content-Encoding": "gzip"},
    ],
    ids=str,
)
async def test_a_body_of_another_kind(serving, check_problem, headers):
    async with serving() as service:
        check_problem(await service.client.post(PATH, content=b"t,u,y\n", headers=headers), 415, "wrong-media-type")


async def test_an_upload_is_bounded_by_what_arrives(serving, configure, check_problem, upload):
    assert ServiceTable().upload_limit_bytes == 32 * 1024 * 1024
    sent = itertools.count(1)
    endless = (b"%d,1,1\n" % next(sent) * 100 for _ in itertools.count())
    async with serving(configure(upload_limit_bytes=100_000)) as service:
        small = await service.client.post(PATH, content=b"t,u,y\n" + b" " * 99_994, headers=CSV)
        declared = await service.client.post(PATH, content=b"t,u,y\n" + b" " * 100_000, headers=CSV)
        streamed = await upload(service.app, PATH, endless, **CSV)
    check_problem(small, 422, "unusable-recording")
    check_problem(declared, 413, "body-too-large")
    check_problem(streamed, 413, "body-too-large")
    assert next(sent) < 200


async def test_an_upload_that_is_broken_off_is_no_fault_of_ours(serving, check_problem, upload):
    async with serving() as service:
        check_problem(await upload(service.app, PATH, [b"t,u,y\n", None], **CSV), 400, "about:blank")


@dataclass(frozen=True)
class SlowUploads(InPlace):
    """Takes an hour for an upload, and counts those that are worked on at once."""

    active: list[object] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)

    async def run(self, function, /, *args, **kwargs):
        if function is identify_csv:
            self.active.append(args)
            self.counts.append(len(self.active))
            await asyncio.sleep(3600.0)
            self.active.pop()
        return await super().run(function, *args, **kwargs)


async def test_uploads_wait_for_each_other_and_never_hold_a_tuning(serving, step_test):
    pool = SlowUploads()
    async with serving(pool=pool) as service:
        content = text_of(step_test)
        uploads = [
            asyncio.create_task(service.client.post(PATH, content=content, headers=CSV))
            for _ in range(UPLOADS_OF_A_CLIENT)
        ]
        await service.client.post("/v1/loops/heater/tunings")
        await service.client.get("/v1/tunings/tuning-1/events")
        result = (await service.client.get("/v1/tunings/tuning-1")).json()
        assert result["verdict"]["outcome"] == "done"
        assert not any(upload.done() for upload in uploads)
        answers = await asyncio.gather(*uploads)
    assert len(answers) > 1
    assert {answer.status_code for answer in answers} == {200}
    assert max(pool.counts) == 1


@pytest.mark.long  # tests/cli identifies with the moments of the output
async def test_a_part_of_the_record_can_be_chosen_and_the_moments_declared(serving, step_test, check_problem):
    t, output, pv = step_test
    content = text_of((t, output, np.where(t > 50.0, 0.0, pv)))
    async with serving() as service:
        part = await service.client.post(
            f"{PATH}?structure=fopdt&start_s=1&end_s=50&moments=between", content=content, headers=CSV
        )
        nothing = await service.client.post(f"{PATH}?start_s=500", content=content, headers=CSV)
        unknown = await service.client.post(f"{PATH}?moments=sometimes", content=content, headers=CSV)
    told = part.json()
    assert told["duration_s"] == pytest.approx(49.0)
    assert told["model"]["K"] == pytest.approx(2.0, rel=0.02)
    check_problem(nothing, 422, "unusable-recording")
    assert unknown.status_code == 422


@pytest.mark.long  # tests/control/test_analysis has such a record
async def test_a_record_that_something_else_moved_gets_no_gains(serving, step_test):
    t, output, pv = step_test
    swaying = pv + 12.0 * np.sin(t / 3.0)
    async with serving() as service:
        told = (await service.client.post(PATH, content=text_of((t, output, swaying)), headers=CSV)).json()
    assert told["gains"] is None
    assert told["model"] is None or "is not explained" in told["warnings"][0]


@pytest.mark.long  # tests/cli and tests/identification have disturbances
async def test_a_measured_disturbance_is_told_apart(serving, step_test, check_problem):
    t, output, pv = step_test
    load = np.where((t > 20.0) & (t < 40.0), 3.0, 0.0)
    answer = 1.0 - np.exp(-np.clip(t - 22.0, 0.0, None) / 10.0) - (1.0 - np.exp(-np.clip(t - 42.0, 0.0, None) / 10.0))
    content = text_of((t, output, pv + 1.5 * answer, load), "t,u,y,load")
    async with serving() as service:
        told = await service.client.post(f"{PATH}?structure=fopdt&disturbance=load", content=content, headers=CSV)
        absent = await service.client.post(f"{PATH}?disturbance=wind", content=content, headers=CSV)
    (one,) = told.json()["disturbances"]
    assert (one["name"], one["gain"], one["D"]) == ("load", pytest.approx(0.5, rel=0.01), pytest.approx(2.0, abs=0.1))
    assert told.json()["model"]["K"] == pytest.approx(2.0, rel=0.01)
    assert check_problem(absent, 422, "unusable-value")["field"] == "disturbance"
