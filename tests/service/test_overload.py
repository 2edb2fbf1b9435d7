"""Access and abort under attack: closed by default, bounded for each client, and abort always within reach."""

import asyncio
import contextlib
import logging
import shutil
import socket
from pathlib import Path
from queue import SimpleQueue

import pytest

from autotuner.errors import StorageError
from autotuner.service.connections import (
    ACCEPTED_AT_ONCE,
    REFUSAL_INTERVAL_S,
    REQUEST_LIMIT_S,
    Connections,
    Listener,
    connections_for,
)
from autotuner.service.errors import OverloadedError, TooManyRequestsError
from autotuner.service.operations.logs import BURST_BYTES, BYTES_PER_S, MOST_WAITING, LogBudget
from autotuner.service.security.access import BODY_GRACE_S
from autotuner.service.security.limits import Buckets, Places, Thinning, client_of
from autotuner.service.security.tokens import FILE, Role, Tokens

START = "/v1/loops/heater/tunings"


def moved(path):
    path.rename(path.with_suffix(".old"))


def replaced_by_a_folder(path):
    path.unlink()
    path.mkdir()


LOSSES = {
    "removed": Path.unlink,
    "moved": moved,
    "folder removed": lambda path: shutil.rmtree(path.parent),
    "not readable": replaced_by_a_folder,
    "[]": lambda path: path.write_text("[]"),
    "{}": lambda path: path.write_text("{}"),
    "null": lambda path: path.write_text("null"),
    "empty": lambda path: path.write_text(""),
    "deep": lambda path: path.write_text("[" * 100_000),
}


@pytest.mark.virtual_time
@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
async def test_access_is_closed_when_the_tokens_are_lost(serving, configure, check_problem, caplog, loss, host):
    configuration = configure(host=host)
    tokens = Tokens(Path(configuration.service.data_directory))
    bearer = {"Authorization": f"Bearer {tokens.add('engineer', Role.OPERATOR)}"}
    file = Path(configuration.service.data_directory) / FILE
    content = file.read_bytes()
    caplog.set_level(logging.WARNING)
    async with serving(configuration) as service:
        if host == "127.0.0.1":  # beyond loopback tokens are required from the start, before anybody has sent one
            assert (await service.client.get("/v1/loops", headers=bearer)).status_code == 200
        LOSSES[loss](file)
        for headers in ({}, bearer):
            check_problem(await service.client.get("/v1/loops", headers=headers), 507, "storage-error")
            check_problem(await service.client.post(START, headers=headers), 507, "storage-error")
            told = check_problem(await service.client.get("/readyz", headers=headers), 507, "storage-error")
            assert told["field"] == FILE
            assert str(file.parent) not in str(told)
        assert (await service.client.get("/healthz")).status_code == 200
        assert service.manager.tunings == {}
        assert [record.message for record in caplog.records if "access is closed" in record.message][1:] == []
        shutil.rmtree(file, ignore_errors=True)
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(content)
        assert (await service.client.get("/v1/loops", headers=bearer)).status_code == 200
        assert "access is open again" in caplog.text


def test_tokens_are_not_required_before_the_first(tmp_path):
    assert Tokens(tmp_path).required is False
    with pytest.raises(StorageError, match="no client is admitted"):
        _ = Tokens(tmp_path, required=True).required


@pytest.mark.virtual_time
async def test_failed_logins_are_recorded_and_slowed_down_and_a_valid_token_is_not(serving, configure, check_problem):
    configuration = configure(requests_per_s=10.0)
    secret = Tokens(Path(configuration.service.data_directory)).add("engineer", Role.OPERATOR)
    bearer = {"Authorization": f"Bearer {secret}"}
    async with serving(configuration) as service:
        statuses = [
            (await service.client.get("/v1/loops", headers={"Authorization": f"Bearer {k}"})).status_code
            for k in range(30)
        ]
        assert statuses == [401] * 10 + [429] * 20
        assert (await service.client.post(f"{START}", headers=bearer)).status_code == 202
        await asyncio.sleep(60.0)
        assert (await service.client.get("/v1/loops")).status_code == 401
        entries = (await service.client.get("/v1/audit", headers=bearer)).json()["entries"]
    refused = [entry for entry in entries if entry["actor"] == "address 127.0.0.1"]
    assert [entry["status"] for entry in refused] == [401] * 11
    assert refused[0]["action"] == "GET /v1/loops (20 refused before)"


FLOODS = {
    "requests": ("GET", "/v1/loops", {}),
    "health": ("GET", "/readyz", {}),
    "aborts of something else": ("POST", "/v1/tunings/unknown/abort", {}),
    "wrong method": ("GET", "{tuning}/abort", {}),
    "two kinds of length": ("POST", "{tuning}/abort", {"Content-Length": "0", "Transfer-Encoding": "chunked"}),
    "another origin": ("POST", "{tuning}/abort", {"Origin": "http://evil.example"}),
}


@pytest.mark.virtual_time
@pytest.mark.parametrize("kind", FLOODS)
async def test_abort_and_health_pass_while_the_same_client_floods(serving, configure, kind):
    method, path, headers = FLOODS[kind]
    async with serving(configure(requests_per_s=10.0)) as service:
        tuning = (await service.client.post(START)).json()["links"]["self"]
        sent = [service.client.request(method, path.format(tuning=tuning), headers=headers) for _ in range(300)]
        assert [(await one).status_code for one in sent].count(429) > 150
        assert (await service.client.get("/healthz")).status_code == 200
        if kind != "health":
            assert (await service.client.get("/readyz")).status_code == 200
        assert (await service.client.post(f"{tuning}/abort")).status_code == 202


@pytest.mark.virtual_time
async def test_two_kinds_of_length_are_refused(serving, check_problem):
    headers = {"Content-Length": "2", "Transfer-Encoding": "chunked"}
    async with serving() as service:
        answer = await service.client.post(START, content=b"{}", headers=headers)
        assert service.manager.tunings == {}
    check_problem(answer, 400, "ambiguous-length")
    assert answer.headers["connection"] == "close"


@pytest.mark.virtual_time
async def test_a_body_that_stops_arriving_is_given_up(serving, check_problem):
    """The rest of it would hold a place for ever."""
    sent = {"type": "http.request", "body": b"{", "more_body": True}
    answers, loop = [], asyncio.get_running_loop()

    async def receive():
        if sent:
            return {key: sent.pop(key) for key in list(sent)}
        return await loop.create_future()

    async def send(message):
        answers.append(message)

    headers = [(b"host", b"localhost"), (b"content-type", b"application/json"), (b"content-length", b"60000")]
    scope = {"type": "http", "method": "POST", "path": START, "root_path": "", "query_string": b"", "headers": headers}
    async with serving() as service:
        begun_s = loop.time()
        await service.app(scope, receive, send)
        assert BODY_GRACE_S <= loop.time() - begun_s < BODY_GRACE_S + 1.0
    assert answers[0]["status"] == 408


def test_places_are_bounded_for_each_client_and_for_all():
    places = Places(3, 2)
    with places.place("a"), places.place("a"):
        with pytest.raises(TooManyRequestsError), places.place("a"):
            pass
        with places.place("b"), pytest.raises(OverloadedError), places.place("c"):
            pass
        with places.place("c"):
            pass
    with places.place("a"):
        pass


def test_of_many_refusals_some_are_recorded_with_the_number_of_the_others():
    thinning = Thinning(Buckets(0.1, 2.0), Buckets(1.0, 3.0))
    assert [thinning.recorded("a", 0.0) for _ in range(4)] == [0, 0, None, None]
    assert [thinning.recorded("b", 0.0) for _ in range(2)] == [0, None]  # all clients together have none left
    assert thinning.recorded("a", 10.0) == 2
    assert thinning.recorded("b", 10.0) == 1


@pytest.mark.parametrize(
    ("address", "client"),
    [
        ("10.0.0.7", "10.0.0.7"),
        ("::ffff:10.0.0.7", "10.0.0.7"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("", "unknown"),
        ("x" * 1000, "x" * 64),
    ],
)
def test_a_client_is_an_address_or_the_network_of_a_subscriber(address, client):
    assert client_of(address) == client


def record(name, text="x" * 850):
    return logging.LogRecord(name, logging.INFO, __file__, 1, text, (), None)


def test_the_log_grows_by_less_than_a_megabyte_a_minute_and_the_loops_keep_their_part():
    now_s = 0.0
    budget = LogBudget(lambda: now_s, SimpleQueue())
    written = 0
    for step in range(600):
        now_s = 0.1 * step
        written += 1000 * sum(budget.filter(record("uvicorn.access")) for _ in range(50))
        written += 1000 * sum(budget.filter(record("uvicorn.error")) for _ in range(50))
        assert step % 5 or budget.filter(record("autotuner.control"))
    assert 2 * 60 * BYTES_PER_S - 2000 < written < 2 * (BURST_BYTES + 61 * BYTES_PER_S) < 1e6


def test_lines_that_nobody_reads_are_left_out_and_counted(caplog):
    records = SimpleQueue()
    budget = LogBudget(lambda: 0.0, records)
    for _ in range(MOST_WAITING):
        records.put(record("autotuner.control"))
    assert not any(budget.filter(record("autotuner.control")) for _ in range(3))
    records.get()
    assert budget.filter(record("autotuner.control"))
    assert "3 lines of the service were left out of the log" in caplog.text


@pytest.mark.realtime
async def test_idle_connections_give_way_and_only_those():
    """Served connections stay; of the idle ones the oldest of the address with most of them goes."""
    connections = Connections(4)
    pairs = [socket.socketpair() for _ in range(6)]
    with contextlib.ExitStack() as held:
        for pair in pairs:
            held.enter_context(pair[0])
            held.enter_context(pair[1])
        addresses = [("10.0.0.1", 1), ("10.0.0.2", 2), ("10.0.0.1", 3), ("10.0.0.1", 4)]
        for k, address in enumerate(addresses):
            assert connections.admit(pairs[k][0], address, float(k))
        held.enter_context(connections.request(addresses[0]))
        assert connections.admit(pairs[4][0], ("10.0.0.3", 5), 4.0)
        assert pairs[2][1].recv(1) == b""  # the oldest idle one of the address with two of them
        for address in (addresses[1], addresses[3], ("10.0.0.3", 5)):
            held.enter_context(connections.request(address))
        assert not connections.admit(pairs[5][0], ("10.0.0.4", 6), 5.0)
        connections.cut_idle(1e6)
        pairs[0][1].setblocking(False)
        with pytest.raises(BlockingIOError):
            pairs[0][1].recv(1)


@pytest.mark.virtual_time
async def test_of_the_refusals_one_is_sent_every_interval_and_their_connections_give_way_meanwhile():
    connections, sent, pairs = Connections(3), [], [socket.socketpair() for _ in range(4)]
    with contextlib.ExitStack() as held:
        for pair in pairs:
            held.enter_context(pair[0])
            held.enter_context(pair[1])

        async def send(message):
            sent.append((asyncio.get_running_loop().time() - begun_s, message["status"]))

        async def request(k, status):
            with connections.request(("10.0.0.1", k)) as connection:
                await connections.paced(send, connection)({"type": "http.response.start", "status": status})

        for k in range(3):
            assert connections.admit(pairs[k][0], ("10.0.0.1", k), 0.0)
        begun_s = asyncio.get_running_loop().time()
        async with asyncio.TaskGroup() as group:
            for k, status in enumerate((429, 503, 200)):
                group.create_task(request(k, status))
            await asyncio.sleep(0.0)
            assert connections.admit(pairs[3][0], ("10.0.0.2", 0), 0.0)  # in place of the one that waits
    expected = [(0.0, 200), (0.0, 429), (REFUSAL_INTERVAL_S, 503)]
    assert [(pytest.approx(at_s), status) for at_s, status in expected] == sorted(sent)


@pytest.mark.realtime
async def test_a_listener_serves_between_floods_and_ends_what_waits_too_long():
    connections = Connections(8)
    listener = Listener(socket.create_server(("127.0.0.1", 0)), connections)
    opened = asyncio.Semaphore(0)

    async def serve(reader, writer):
        opened.release()
        await reader.read()
        writer.close()

    async with await asyncio.start_server(serve, sock=listener) as server:
        address = server.sockets[0].getsockname()
        clients = [await asyncio.open_connection(*address) for _ in range(3 * ACCEPTED_AT_ONCE)]
        last = clients[-1][0]
        for _ in clients:
            await opened.acquire()
        assert not last.at_eof()
        connections.cut_idle(asyncio.get_running_loop().time() + REQUEST_LIMIT_S + 1.0)
        assert await asyncio.wait_for(last.read(), 5.0) == b""
        for _, writer in clients:
            writer.close()


def test_connections_stay_below_the_file_limit():
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        assert connections_for(256).limit == 2048
        assert connections_for(10**9).limit <= hard
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] > connections_for(256).limit
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.virtual_time
async def test_a_proxy_is_believed_only_where_it_is_named(serving, configure):
    for proxies, allowed in (((), 10), (("127.0.0.1",), 20)):
        configuration = configure(requests_per_s=10.0, proxies=list(proxies))
        async with serving(configuration) as service:
            codes = [
                (
                    await service.client.get(
                        "/v1/loops", headers={"Host": "evil.example", "X-Forwarded-For": f"10.0.0.{k % 2}"}
                    )
                ).status_code
                for k in range(40)
            ]
        assert codes.count(421) == allowed
