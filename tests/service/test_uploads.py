"""Hostile and huge uploads: bounded and refused in words, on both paths; a diagnosis of what can be used."""

import json

import numpy as np
import pytest

from autotuner.configuration import ServiceTable
from autotuner.service.computations import MOST_LINES
from autotuner.service.schemas.diagnosis import Diagnosis

pytestmark = pytest.mark.virtual_time

PATHS = ["/v1/identifications", "/v1/diagnoses"]
CSV = {"Content-Type": "text/csv"}
MIB = 1024 * 1024
RAMP = "".join(f"{k},{k // 9 % 2},{k // 9 % 2}\n" for k in range(60))


def rows(value, count=300):
    return b"t,u,y\n" + b"".join(b"%d,%s\n" % (k, value(k)) for k in range(count))


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("declared", [{}, {"Content-Length": str(1024 * MIB)}], ids=["undeclared", "declared"])
async def test_a_gigabyte_is_not_taken(serving, check_problem, upload, path, declared):
    sent = []

    def gigabyte():
        for _ in range(1024):
            sent.append(MIB)
            yield b"1,1,1\n" * (MIB // 6)

    async with serving() as service:
        answer = await upload(service.app, path, gigabyte(), **CSV, **declared)
    check_problem(answer, 413, "body-too-large")
    assert sum(sent) <= (0 if declared else ServiceTable().upload_limit_bytes + 2 * MIB)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("encoding", ["gzip", "deflate", "br", "zstd", "gzip, gzip", "identity, gzip"])
async def test_a_packed_body_is_never_unpacked(serving, check_problem, path, encoding):
    async with serving() as service:
        answer = await service.client.post(path, content=b"\x1f\x8b", headers={**CSV, "Content-Encoding": encoding})
    check_problem(answer, 415, "wrong-media-type")


@pytest.mark.parametrize("path", PATHS)
async def test_a_recording_with_too_many_lines_is_not_parsed(serving, check_problem, path):
    async with serving() as service:
        answer = await service.client.post(path, content=b"t,u,y\n" + b"1,1,1\n" * (MOST_LINES + 1), headers=CSV)
    problem = check_problem(answer, 422, "unusable-recording")
    assert str(MOST_LINES) in problem["detail"]


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(
    "content",
    [
        rows(lambda _: b"nan,nan"),
        rows(lambda _: b"inf,1e400"),
        rows(lambda k: b"%d,%s1e308" % (k // 9 % 2, b"-" if k % 18 > 9 else b"")),
        b"t,u,y\n" + b"".join(b"%de-300,%d,%d\n" % (k, k // 9 % 2, k // 9 % 2) for k in range(300)),
        b"t,u,y\n0,1," + b"9" * 200_000 + b"\n1,1,1\n",
        b't,u,y\n"' + b"\n" * 200_000,
        b"t,u,y" + b",a" * 100_000 + b"\n0,1,1\n1,1,1\n",
        b"t,u,y\n0,1,\x00\n1,1,1\n",
        ("t,u,y\n" + RAMP).encode("utf-16-le"),
        bytes(range(256)) * 40,
    ],
    ids=["nan", "infinite", "huge", "no time", "long cell", "open quote", "wide", "nul", "utf-16", "bytes"],
)
async def test_what_is_no_recording_is_refused_in_words(serving, check_problem, path, content):
    async with serving() as service:
        answer = await service.client.post(path, content=content, headers=CSV)
    assert check_problem(answer, 422, "unusable-recording")["remedy"]


async def test_a_long_recording_is_diagnosed_with_its_curves(serving, undescribed):
    """Longer than what a body may be elsewhere: a step of 10 on K = 2, T = 10 s, D = 1.5 s by its closed form."""
    t = np.arange(0.0, 300.0, 0.1)
    output = 40.0 + 10.0 * (t >= 20.0)
    pv = 80.0 + 20.0 * (1.0 - np.exp(-np.clip(t - 21.5, 0.0, None) / 10.0))
    pv += 0.05 * np.random.default_rng(1).standard_normal(t.size)
    content = "t,u,y\n" + "".join(
        f"{a!r},{b!r},{c!r}\n" for a, b, c in zip(*map(np.ndarray.tolist, (t, output, pv)), strict=True)
    )
    assert len(content) > 64 * 1024
    async with serving() as service:
        answer = await service.client.post("/v1/diagnoses?points=200", content=content, headers=CSV)
        bare = await service.client.post("/v1/diagnoses", content=content, headers=CSV)
    told = answer.json()
    assert answer.status_code == 200, told
    assert undescribed(Diagnosis.model_validate(told)) == {}
    assert told["verdict"] == "adequate"
    assert told["model"]["after"]["T"] == pytest.approx(10.0, rel=0.03)
    assert 100 <= len(told["curves"]["t_s"]) <= 200
    assert json.loads(bare.text)["curves"] is None
