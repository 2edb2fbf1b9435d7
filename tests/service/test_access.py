"""Who is turned away: other machines, other names, pages of other origins, and bodies without end."""

import itertools

import pytest

from autotuner.errors import ConfigurationError
from autotuner.service.security.access import BODY_LIMIT
from autotuner.service.security.loopback import is_loopback
from autotuner.service.security.tokens import Role, Tokens, require_protection

START = "/v1/loops/heater/tunings"


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.1.7", "::1", "localhost"])
def test_loopback_is_served(host, tmp_path):
    assert is_loopback(host)
    require_protection(host, loopback=True, tokens=Tokens(tmp_path))


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "", "192.168.0.7", "::ffff:10.0.0.1", "plc.example", "127.1"])
def test_what_other_machines_reach_is_refused_without_a_token(host, tmp_path):
    tokens = Tokens(tmp_path)
    with pytest.raises(ConfigurationError, match=r"service\.host: is not a loopback address") as refused:
        require_protection(host, loopback=is_loopback(host), tokens=tokens)
    assert refused.value.value == host
    tokens.add("control room", Role.VIEWER)
    require_protection(host, loopback=is_loopback(host), tokens=tokens)


@pytest.mark.virtual_time
@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:8321", "127.0.0.1:9000", "[::1]:8321", "127.0.0.5:1"])
async def test_own_names_are_served(serving, configure, host):
    async with serving(configure(host="127.0.0.5")) as service:
        answer = await service.client.get("/v1/loops", headers={"Host": host})
    assert answer.status_code == 200


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    "host", ["evil.example", "localhost.evil.example:8321", "127.0.0.1.nip.example", "", "[::1", "127.0.0.5"]
)
async def test_a_rebound_name_is_turned_away(serving, check_problem, host):
    async with serving() as service:
        answer = await service.client.get("/v1/loops", headers={"Host": host})
    assert check_problem(answer, 421, "foreign-host")["value"] == repr(host)


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://evil.example"},
        {"Origin": "http://localhost:3000"},
        {"Origin": "https://localhost:8321"},
        {"Origin": "http://localhost:8321.evil.example"},
        {"Origin": "null"},
        {"Origin": ""},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ],
    ids=str,
)
async def test_a_page_of_another_origin_moves_nothing(serving, check_problem, headers):
    async with serving() as service:
        check_problem(await service.client.post(START, headers=headers), 403, "foreign-origin")
        assert service.manager.tunings == {}
        read = await service.client.get("/v1/loops", headers=headers)
    assert read.status_code == 200
    assert "access-control-allow-origin" not in read.headers


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    "headers",
    [{}, {"Origin": "http://localhost:8321", "Sec-Fetch-Site": "same-origin"}, {"Sec-Fetch-Site": "none"}],
    ids=str,
)
async def test_our_own_page_and_programs_may(serving, headers):
    async with serving() as service:
        assert (await service.client.post(START, headers=headers)).status_code == 202


@pytest.mark.virtual_time
async def test_a_declared_body_that_is_too_large_is_not_read(serving, check_problem):
    async with serving() as service:
        at_limit = await service.client.post(START, content=b" " * (BODY_LIMIT - 2) + b"{}")
        beyond = await service.client.post(START, content=b" " * BODY_LIMIT + b"{}")
    check_problem(at_limit, 422, "unusable-value")
    check_problem(beyond, 413, "body-too-large")


@pytest.mark.virtual_time
@pytest.mark.parametrize("declared", [{}, {"Content-Length": "2"}], ids=["undeclared", "declared too small"])
async def test_a_body_without_end_is_cut_off_by_what_has_arrived(serving, check_problem, upload, declared):
    sent = itertools.count(1)
    endless = (b" " * 10_000 for _ in sent)
    async with serving() as service:
        answer = await upload(service.app, START, endless, **{"Content-Type": "application/json", **declared})
    check_problem(answer, 413, "body-too-large")
    assert next(sent) * 10_000 <= BODY_LIMIT + 20_000


@pytest.mark.virtual_time
async def test_reading_needs_no_origin_and_writing_methods_are_all_checked(serving, check_problem):
    async with serving() as service:
        for method in ("POST", "PUT", "PATCH", "DELETE"):
            answer = await service.client.request(method, "/v1/loops", headers={"Origin": "http://evil.example"})
            check_problem(answer, 403, "foreign-origin")
