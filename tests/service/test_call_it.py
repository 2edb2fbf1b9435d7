"""docs/how-to/call-it.md against a running service: its Python and its bytes for a PLC do what the page says."""

import json
import re
import socket
import subprocess
import sys
import urllib.request

import pytest

from tests.control.processes import PATIENCE_S, until

pytestmark = pytest.mark.realtime

LOOP = """
[service]
data_directory = "data"

[loops.TIC-101]
driver = "simulated"
sample_time_s = 0.02
relay = { amplitude = 10.0, quiet_s = 0.6, max_periods = 4, check = false }
device = { plant = { structure = "fopdt", K = 2.0, T = 0.6, D = 0.2 }, output0 = 40.0, pv0 = 80.0, noise = 0.05 }
"""


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    folder = tmp_path_factory.mktemp("service")
    (folder / "autotuner.toml").write_text(LOOP, encoding="utf-8")
    command = [sys.executable, "-m", "autotuner.cli", "serve", "--json", "--port", "0"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as running:
        yield json.loads(running.stdout.readline())["listening"].removeprefix("http://")
        running.terminate()


def blocks(pytestconfig, kind):
    page = (pytestconfig.rootpath / "docs" / "how-to" / "call-it.md").read_text(encoding="utf-8")
    return re.findall(rf"```{kind}\n(.*?)```", page, re.DOTALL)


def send(address, text):
    """Send the lines of a request as they stand, and return status, headers and body."""
    host, _, port = address.partition(":")
    head, _, body = text.replace("127.0.0.1:8321", address).partition("\n\n")
    with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as line:
        line.sendall(head.replace("\n", "\r\n").encode() + b"\r\n\r\n" + body.strip().encode())
        answer = b"".join(iter(lambda: line.recv(65536), b"")).decode()
    head, _, body = answer.partition("\r\n\r\n")
    return int(head.split()[1]), dict(re.findall(r"^([\w-]+): (.*?)\r?$", head.lower(), re.MULTILINE)), body


def wait_for_rest(address):
    """Return when the PV is back where the plant rests, after a tuning before."""

    def rests():
        with urllib.request.urlopen(f"http://{address}/v1/readings", timeout=PATIENCE_S) as answer:
            (reading,) = json.load(answer)["readings"]
        return reading["pv"] is not None and abs(reading["pv"] - 80.0) < 0.25

    until(rests)


def test_a_plc_starts_a_tuning_and_polls_it(address, pytestconfig):
    start, poll = blocks(pytestconfig, "http")
    status, headers, _ = send(address, start)
    assert status == 202
    identifier = headers["location"].rpartition("/")[2]

    def ended():
        status, _, body = send(address, poll.replace("ID", identifier))
        assert status == 200
        return body if '"state":"ended"' in body else None

    body = until(ended)
    assert '"outcome":"done"' in body
    assert set(json.loads(body)["gains"]) >= {"Kp", "Ti", "Td"}


def test_a_python_program_tunes(address, pytestconfig, capsys):
    wait_for_rest(address)
    (code,) = [block for block in blocks(pytestconfig, "python") if "autotuner.client" in block]
    exec(compile(code.replace("127.0.0.1:8321", address), "call-it.md", "exec"), {})  # noqa: S102 - the page is ours
    told = capsys.readouterr().out
    assert told.startswith("done fopdt: K ")
    assert len(told.splitlines()[1].split()) == 3
