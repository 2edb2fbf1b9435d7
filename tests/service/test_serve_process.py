"""The service as a process: real sockets, worker processes and signals."""

import contextlib
import json
import queue
import signal
import socket
import subprocess
import sys
import threading

import httpx
import pytest
from pyModbusTCP.client import ModbusClient

from autotuner.cli import main
from autotuner.configuration import parse_configuration
from autotuner.service import serve as serve_module
from autotuner.service.errors import ListenError
from tests.control.processes import PATIENCE_S, until

pytestmark = pytest.mark.realtime

FAST = """
[loops.fast]
driver = "simulated"
sample_time_s = 0.02
relay = { amplitude = 10.0, quiet_s = 0.5, max_periods = 4, check = false }
device = { plant = { structure = "fopdt", K = 2.0, T = 0.5, D = 0.2 }, output0 = 40.0, pv0 = 80.0, noise = 0.05 }
"""
PLC = """
[loops.TIC-101]
driver = "modbus"
sample_time_s = 0.1
relay = {{ amplitude = 10.0, quiet_s = 2.0 }}

[loops.TIC-101.device]
host = "127.0.0.1"
port = {port}

[loops.TIC-101.device.registers]
pv = {{ table = "input", address = 0, type = "int16", scale = 0.1 }}
output = {{ table = "holding", address = 0, type = "int16", scale = 0.1 }}
auto = {{ table = "coil", address = 0 }}
"""

BREAKING = """
import asyncio, signal, sys
from autotuner.cli import main
from autotuner.service.serve import _Server
startup = _Server.startup

async def breakable(self, sockets):
    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, sys.exit, 3)
    await startup(self, sockets)

_Server.startup = breakable
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture
def start(tmp_path):
    """Return a function that starts a command of the product and returns the process with its first line."""
    running = []

    def run(*arguments, config=None, program=("-m", "autotuner.cli")):
        if config is not None:
            (tmp_path / "loops.toml").write_text(config, encoding="utf-8")
            arguments = (*arguments, "--config", str(tmp_path / "loops.toml"))
        process = subprocess.Popen(
            [sys.executable, *program, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
        )
        running.append(process)
        return process, process.stdout.readline()

    yield run
    for process in running:
        if process.poll() is None:
            process.kill()
        process.communicate()


def serve(start, config):
    process, line = start("serve", "--json", "--port", "0", config=config)
    assert line, process.communicate()[1]
    return process, httpx.Client(base_url=json.loads(line)["listening"], timeout=PATIENCE_S)


def check_ended(process):
    """Check that the process ends by itself and well; its log may tell of trouble with the link, never of a fault."""
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (out, process.returncode) == ("", 0), err
    assert "Traceback" not in err


def follow(client):
    """Yield the live events of the first tuning as they arrive."""
    with client.stream("GET", f"{client.get('/v1/tunings').json()['tunings'][0]['links']['events']}") as stream:
        yield from (json.loads(line[6:]) for line in stream.iter_lines() if line.startswith("data: "))


def test_a_loop_is_tuned_and_the_service_stopped(start):
    process, client = serve(start, FAST)
    with client:
        path = client.post("/v1/loops/fast/tunings").headers["location"]
        events = list(follow(client))
        result = client.get(path).json()
        assert events[-1]["type"] == "ended"
        assert result["verdict"]["outcome"] == "done", result["verdict"]
        assert result["restored"] is True
        assert client.post(f"{path}/gains", json={"goal": "calm"}).json()["goal"] == "calm"
        recording = client.get(f"{path}/recording").text
        upload = client.post("/v1/identifications", content=recording, headers={"Content-Type": "text/csv"})
        assert upload.json()["samples"] == result["samples"]
        refused = client.post("/v1/identifications", content="t,u,y\n", headers={"Content-Type": "text/csv"})
        assert refused.status_code == 422
    process.send_signal(signal.SIGTERM)
    check_ended(process)


def test_a_service_manager_hears_that_it_is_ready_lives_and_stops(start, tmp_path, monkeypatch):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(str(tmp_path / "notify"))
        line.settimeout(PATIENCE_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "400000")
        heard = queue.SimpleQueue()
        manager = threading.Thread(target=lambda: list(map(heard.put, iter(lambda: line.recv(100).decode(), "END"))))
        manager.start()  # the system keeps ten messages for a reader that is late, and drops the next
        process, client = serve(start, FAST)
        words = iter(lambda: heard.get(timeout=PATIENCE_S), None)
        with client:
            assert {word.partition("=")[0] for word in iter(words.__next__, "READY=1")} == {"EXTEND_TIMEOUT_USEC"}
            assert [next(words), next(words)] == ["WATCHDOG=1"] * 2
        process.send_signal(signal.SIGTERM)
        check_ended(process)
        assert "STOPPING=1" in words
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as own:
            own.sendto(b"END", str(tmp_path / "notify"))
        manager.join()


def test_a_second_service_on_the_same_data_directory_is_refused(start):
    """It would tell the running tunings of the first as interrupted; once that has ended, or was killed, it may."""
    first, client = serve(start, FAST)
    client.close()
    second, line = start("serve", "--json", "--port", "0", config=FAST)
    _, err = second.communicate(timeout=PATIENCE_S)
    assert (line, second.returncode) == ("", 2), err
    assert f"service.data_directory: is in use by another service (process {first.pid}, " in err
    assert "Traceback" not in err
    first.kill()
    first.wait()
    third, client = serve(start, FAST)
    client.close()
    third.send_signal(signal.SIGTERM)
    check_ended(third)


def test_sigterm_in_the_middle_of_a_tuning_gives_the_loop_back(start):
    """A PLC in another process, asked by another's client, tells what the service did to it."""
    _, ready = start("plc", "--port", "0", "--auto", "--gains", "0", "20", "0", "--scan", "0.02")
    port = json.loads(ready)["port"]
    process, client = serve(start, PLC.format(port=port))
    device = ModbusClient(host="127.0.0.1", port=port, auto_open=True)
    with client, contextlib.closing(device):
        assert (device.read_coils(0), device.read_holding_registers(0)) == ([True], [400])
        client.post("/v1/loops/TIC-101/tunings")
        events = follow(client)
        moved = next(event for event in events if event["type"] == "sample" and event["output"] > 45.0)
        assert (device.read_coils(0), device.read_holding_registers(0)) == ([False], [round(10 * moved["output"])])
        process.send_signal(signal.SIGTERM)
        *_, event = events
        assert (event["type"], event["code"]) == ("ended", "shutdown")
        check_ended(process)
        assert (device.read_coils(0), device.read_holding_registers(0)) == ([True], [400])


def test_a_fault_that_breaks_the_service_down_gives_the_loops_back(start):
    """A simulated loop in its event loop, and the loop of a PLC in the loop process."""
    _, ready = start("plc", "--port", "0", "--auto", "--gains", "0", "20", "0", "--scan", "0.02")
    port = json.loads(ready)["port"]
    loops = PLC.format(port=port) + FAST.replace("max_periods = 4", "min_periods = 500, max_periods = 1000")
    process, line = start("serve", "--json", "--port", "0", config=loops, program=("-c", BREAKING))
    device = ModbusClient(host="127.0.0.1", port=port, auto_open=True)
    with httpx.Client(base_url=json.loads(line)["listening"], timeout=PATIENCE_S) as client, contextlib.closing(device):
        client.post("/v1/loops/fast/tunings")
        client.post("/v1/loops/TIC-101/tunings")
        assert any(event["type"] == "sample" and event["output"] > 45.0 for event in follow(client))
        process.send_signal(signal.SIGUSR1)
        assert process.wait(PATIENCE_S) == 3
        until(lambda: (device.read_coils(0), device.read_holding_registers(0)) == ([True], [400]))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP], ids=lambda number: number.name)
def test_readers_come_and_go_and_none_holds_the_service(start, closes, number):
    closes(signal.SIG_DFL)
    process, client = serve(start, FAST.replace("max_periods = 4", "min_periods = 500, max_periods = 1000"))
    with client:
        client.post("/v1/loops/fast/tunings")
        for _ in range(3):
            assert next(follow(client))["type"] == "phase"
        events = []
        for event in follow(client):
            events.append(event)
            if event["type"] == "estimate" and event["half_period"] == 3:
                process.send_signal(number)
        assert (events[-1]["type"], events[-1]["code"]) == ("ended", "shutdown")
        (restored,) = (event for event in events if event["type"] == "restored")  # a model may be reported after it
        assert {"output": 40.0, "verified": True}.items() <= restored.items()
    check_ended(process)


def test_a_service_under_nohup_outlives_its_terminal(start, closes):
    closes(signal.SIG_IGN)
    process, client = serve(start, FAST)
    with client:
        process.send_signal(signal.SIGHUP)
        client.post("/v1/loops/fast/tunings")
        assert list(follow(client))[-1]["code"] == "identified"
    process.send_signal(signal.SIGTERM)
    check_ended(process)


def test_an_upload_beyond_the_limit_is_refused_while_it_arrives(start):
    process, client = serve(start, "[service]\nupload_limit_bytes = 100000\n" + FAST)
    head = [
        "POST /v1/identifications HTTP/1.1",
        "Host: localhost",
        "Content-Type: text/csv",
        "Transfer-Encoding: chunked",
    ]
    with client:
        address = (client.base_url.host, client.base_url.port)
        with socket.create_connection(address, timeout=PATIENCE_S) as connection:
            connection.sendall("\r\n".join([*head, "", ""]).encode())
            for _ in range(11):
                connection.sendall(b"2710\r\n" + b"1,1,1\n" * 1666 + b"1,1,\r\n")
            answer = connection.recv(65536)
        assert answer.startswith(b"HTTP/1.1 413 ")
        assert b"application/problem+json" in answer
        assert client.get("/healthz").status_code == 200
    process.send_signal(signal.SIGTERM)
    check_ended(process)


@pytest.fixture
def refused(tmp_path, capsys):
    """Return a function that tries to serve in this process, and returns the exit code and what was said."""

    def run(*arguments):
        file = tmp_path / "loops.toml"
        file.write_text(FAST, encoding="utf-8")
        code = main(["serve", "--json", "--config", str(file), *arguments])
        said = capsys.readouterr()
        assert said.out == ""
        return code, said.err

    return run


def test_a_port_in_use_is_told(refused):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        code, said = refused("--port", port)
    assert code == 1
    assert said == (
        f"autotuner: service.port: cannot listen on 127.0.0.1: Address already in use (got {port}). "
        "Stop the other program, or choose another port (0: any).\n"
    )


@pytest.mark.parametrize(
    ("host", "why"), [("no.such.host.invalid", "not known"), ("192.0.2.1", "Cannot assign requested address")]
)
def test_an_address_of_no_network_here_is_told(host, why):
    """192.0.2.0/24 is kept for examples, and nothing under `.invalid` has an address."""
    service = parse_configuration({"service": {"host": host}, "loops": {"one": {"driver": "simulated"}}}, "t").service
    with pytest.raises(ListenError, match=why) as caught:
        serve_module._listen(service)
    assert (caught.value.field, caught.value.value) == ("service.host", host)
    assert "address of this machine" in caught.value.remedy


def test_no_part_of_an_answer_waits_for_the_acknowledgement_of_the_one_before():
    service = parse_configuration({"service": {"port": 0}, "loops": {"one": {"driver": "simulated"}}}, "test").service
    with (
        serve_module._listen(service) as listener,
        socket.create_connection(listener.getsockname()),
        contextlib.closing(listener.accept()[0]) as accepted,
    ):
        assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0


@pytest.mark.parametrize("host", ["0.0.0.0", "plc.example"])
def test_a_host_that_other_machines_reach_is_refused(refused, host):
    code, said = refused("--host", host)
    assert code == 2
    assert said.startswith("autotuner: service.host: is not a loopback address")
