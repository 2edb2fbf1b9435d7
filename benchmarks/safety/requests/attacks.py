"""Attacks on a served process that tunes a loop of a foreign PLC: what a client sees, and what the loop feels.

    python benchmarks/safety/requests/attacks.py --peer PLC.py [--case NAME ...]

The PLC is a program of its own whose Modbus side shares no code with ours: it takes `--tcp`, `--control`, `--plant`,
`--noise` and `--u0`, and answers `get` on its control port with one JSON line. Each case starts a service of its own on
loopback only, starts a tuning of that PLC, and attacks while it runs. Attacks are bounded in number and time.

    abort      s from the request to abort until its answer, while the attack goes on
    tuning     yes: it ran through the attack and ended by the abort alone
    output     of the PLC, asked by its control port, at its value before within 5 s of the abort
    log        MB a minute, on standard error
    end        s from SIGTERM, sent while the attack goes on, until the process has ended

Cases that name a verdict let the experiment end by itself under an attack: `abort` is then the time from its end to the
verdict. Cases of a sensor that freezes have no client: `abort` is the time until the PLC has its output back, and the
true PV, which the PLC tells by its control port, may have passed the limit of the loop only by what it moved since.
"""

import argparse
import asyncio
import contextlib
import json
import os
import resource
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import httpx

from autotuner.service.security.tokens import Role, Tokens

PATIENCE_S = 60.0
ATTACK_S = 8.0
ABORT_LIMIT_S = 1.0
END_LIMIT_S = 10.0
LOG_LIMIT_MB = 1.0
VERDICT_LIMIT_S = 30.0
"""Longest time from the end of an experiment to its verdict; alone it takes 2 to 5 s, s."""
FROZEN_LIMIT_S = 15.0
"""Longest time until a sensor that froze after its answer is noticed: three times what the answer took, s."""
SILENT_LIMIT_S = 65.0
"""The same for one that froze before: `response_limit_s`, s."""
WORKER_NICENESS = 10
OUTPUT, NEAR = 40.0, 0.25
RELAY = "min_periods = 100, max_periods = 200"
SHORT = "accuracy = 0.05, min_periods = 2, check = false"
CONFIGURATION = """
[service]
data_directory = "{folder}/data"
port = 0

[loops.plc]
driver = "modbus"
sample_time_s = 0.1
relay = {{ amplitude = 10.0, quiet_s = 2.0, {relay} }}
limits = {{ output = [0.0, 100.0], pv = {pv} }}

[loops.plc.device]
host = "127.0.0.1"
port = {port}

[loops.plc.device.registers]
pv = {{ table = "input", address = 0, type = "int16", scale = 0.1 }}
output = {{ table = "holding", address = 0, type = "int16", scale = 0.1 }}
auto = {{ table = "coil", address = 0 }}
"""


class Plc:
    """The foreign PLC."""

    def __init__(self, program):
        arguments = [
            "--tcp",
            "0",
            "--control",
            "0",
            "--plant",
            "2",
            "10",
            "1.5",
            "--noise",
            "0.05",
            "--u0",
            str(OUTPUT),
        ]
        self.process = subprocess.Popen([sys.executable, program, *arguments], stdout=subprocess.PIPE, text=True)  # noqa: S603
        ready = json.loads(self.process.stdout.readline())
        self.port, self._control = ready["tcp"], ready["control"]

    def ask(self, command="get"):
        """Return the answer of its control port: the truth, for `get`."""
        with socket.create_connection(("127.0.0.1", self._control), timeout=5.0) as line:
            line.sendall(f"{command}\n".encode())
            return json.loads(line.makefile().readline())

    def output(self):
        return self.ask()["u_cmd"]

    def close(self):
        self.process.terminate()
        self.process.wait()


class Service:
    """A service in a process of its own, with its log counted."""

    def __init__(self, folder, plc, relay=RELAY, pv_limits=(0.0, 250.0)):
        file = Path(folder) / "loops.toml"
        file.write_text(CONFIGURATION.format(folder=folder, port=plc.port, relay=relay, pv=list(pv_limits)))
        command = [sys.executable, "-m", "autotuner.cli", "serve", "--json", "--config", str(file)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)  # noqa: S603
        self.log_bytes, self.log = 0, []
        self._reader = threading.Thread(target=self._read_log)
        self._reader.start()
        line = self.process.stdout.readline()
        assert line, b"".join(self.log).decode()
        self.port = int(json.loads(line)["listening"].rpartition(":")[2])
        self.begun_s = time.monotonic()

    def _read_log(self):
        for line in self.process.stderr:
            self.log_bytes += len(line)
            if len(self.log) < 2000:
                self.log.append(line)

    def client(self, **headers):
        return httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=PATIENCE_S, headers=headers)

    def log_mb_a_minute(self):
        """Return how fast the log grew; of less than a minute what it held, since a burst is allowed once."""
        return self.log_bytes / 1e6 / max((time.monotonic() - self.begun_s) / 60.0, 1.0)

    def end(self):
        """Send SIGTERM; return the time until the process has ended, s."""
        begun_s = time.monotonic()
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._reader.join()
        return time.monotonic() - begun_s


HEAD = b"POST /v1/loops/plc/plan HTTP/1.1\r\nHost: 127.0.0.1\r\n"


async def connected(port, count, talk):
    """Have so many clients talk over a connection each, and again where it has ended."""

    async def one():
        while True:
            with contextlib.suppress(OSError):
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                try:
                    await talk(reader, writer)
                finally:
                    writer.transport.abort()
            await asyncio.sleep(0.2)

    await asyncio.gather(*(one() for _ in range(count)))


async def held(port, count, data):
    """Open connections that send this and stay as they are until they are closed."""

    async def talk(reader, writer):
        writer.write(data)
        await writer.drain()
        await reader.read()

    await connected(port, count, talk)


async def flood(port, request, count=16):
    """Send requests, always the same or made by a function, one after another over connections that are kept."""
    made = request if callable(request) else lambda: request

    async def one():
        while True:
            with contextlib.suppress(OSError, asyncio.IncompleteReadError):
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                try:
                    while True:
                        writer.write(made())
                        head = await reader.readuntil(b"\r\n\r\n")
                        length = [line for line in head.lower().split(b"\r\n") if line.startswith(b"content-length")]
                        await reader.readexactly(int(length[0].split(b":")[1]) if length else 0)
                finally:
                    writer.close()
            await asyncio.sleep(0.005)

    await asyncio.gather(*(one() for _ in range(count)))


def recording():
    rows = (f"{0.1 * k:.1f},{50 if k // 40 % 2 else 40},{80 + (k % 80) / 8:.3f}" for k in range(6000))
    return ("t,u,y\n" + "\n".join(rows)).encode()


def upload(path):
    body = recording()
    head = f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: text/csv\r\nContent-Length: {len(body)}\r\n\r\n"
    return head.encode() + body


async def dripping(port, count, head):
    """Send bodies a byte at a time, faster than a timeout for reading would notice."""

    async def talk(_reader, writer):
        writer.write(head)
        for _ in range(60):
            writer.write(b" ")
            await writer.drain()
            await asyncio.sleep(0.5)

    await connected(port, count, talk)


async def endless(port, count):
    """Send uploads in chunks that never end."""
    head = b"POST /v1/diagnoses HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: text/csv\r\n"
    head += b"Transfer-Encoding: chunked\r\n\r\n"
    chunk = b"1000\r\n" + b"1,2,3\r\n" * 585 + b"\n\r\n"

    async def talk(_reader, writer):
        writer.write(head)
        while True:
            writer.write(chunk)
            await writer.drain()

    await connected(port, count, talk)


async def deaf(port, count, data):
    """Send, and never read what is answered."""

    async def talk(_reader, writer):
        writer.transport.pause_reading()
        writer.write(data)
        await asyncio.sleep(5.0)

    await connected(port, count, talk)


async def deaf_viewers(port, count):
    """Ask for the events of the running tuning, and never read them."""
    async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{port}") as client:
        newest = (await client.get("/v1/tunings")).json()["tunings"][0]["id"]
    await deaf(port, count, f"GET /v1/tunings/{newest}/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())


ATTACKS = {
    "none": lambda port: held(port, 0, b""),
    "500 half-sent heads": lambda port: held(port, 500, HEAD),
    "500 half-sent bodies": lambda port: held(port, 500, HEAD + b"Content-Length: 60000\r\n\r\n{"),
    "1200 idle connections": lambda port: held(port, 1200, b""),
    "flood of requests": lambda port: flood(port, b"GET /v1/loops HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"),
    "flood of unknown hosts": lambda port: flood(port, b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n"),
    "flood of no HTTP": lambda port: held(port, 200, b"\x16\x03\x01\x02\x00 rubbish\r\n\r\n"),
    "queued diagnoses": lambda port: held(port, 60, upload("/v1/diagnoses")),
    "both kinds of length": lambda port: flood(
        port, HEAD + b"Content-Length: 2\r\nTransfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\n\r\n"
    ),
    "200 dripping bodies": lambda port: dripping(port, 200, HEAD + b"Content-Length: 60\r\n\r\n"),
    "8 endless uploads": lambda port: endless(port, 8),
    "pipelines never read": lambda port: deaf(port, 50, 2000 * b"GET /v1/loops HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"),
    "400 viewers never read": lambda port: deaf_viewers(port, 400),
    "flood of aborts": lambda port: flood(
        port, b"POST /v1/tunings/unknown/abort HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 0\r\n\r\n"
    ),
    "flood of aborts by chance": lambda port: flood(
        port,
        lambda: (
            b"POST /v1/tunings/%s/abort HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 0\r\n\r\n"
            % secrets.token_hex(8).encode()
        ),
    ),
    "flood of health": lambda port: flood(port, b"GET /readyz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"),
    "flood of starts": lambda port: flood(
        port, b"POST /v1/loops/plc/tunings HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 0\r\n\r\n"
    ),
}


@contextlib.contextmanager
def under(attack, port):
    """Attack in a process of its own, which is not slowed down by this one."""
    process = subprocess.Popen([sys.executable, __file__, "--attack", attack, "--port", str(port)])  # noqa: S603
    try:
        yield
    finally:
        process.kill()
        process.wait()


def overloaded(attack, program):
    """Return a row of the table, and what failed."""
    plc = Plc(program)
    with tempfile.TemporaryDirectory() as folder:
        service = Service(folder, plc)
        try:
            with service.client() as client:
                tuning = client.post("/v1/loops/plc/tunings").raise_for_status().json()["links"]["self"]
                while client.get(tuning).json()["phase"] != "relay":
                    time.sleep(0.2)
            with under(attack, service.port):
                time.sleep(ATTACK_S)
                begun_s = time.monotonic()
                with service.client() as client:  # a new connection: a person who comes now
                    status = client.post(f"{tuning}/abort").status_code
                abort_s = time.monotonic() - begun_s
                while abs((output := plc.output()) - OUTPUT) > NEAR and time.monotonic() < begun_s + 5.0:
                    time.sleep(0.05)
                log = service.log_mb_a_minute()
                end_s = service.end()
        finally:
            service.end()
            plc.close()
        ended = [line for line in service.log if b"ended" in line or b"verdict" in line]
        by_abort = any(b"abort" in line for line in service.log)
        failures = {
            f"abort answered {status}": status != 202,
            "abort was late": abort_s > ABORT_LIMIT_S,
            f"the tuning ended otherwise: {ended[:1]}": not by_abort,
            **failures_of_the_end(service, output, log, end_s),
        }
    numbers = f"{abort_s:6.2f}  {'yes' if by_abort else 'no':6}  {output:6.1f}  {log:5.2f}  {end_s:5.1f}"
    return numbers, [what for what, failed in failures.items() if failed]


def failures_of_the_end(service, output, log, end_s):
    """Return what may be wrong with the end of a service, each with whether it is."""
    return {
        "the output was not restored": abs(output - OUTPUT) > NEAR,
        "the log grew too fast": log > LOG_LIMIT_MB,
        "the end was late": end_s > END_LIMIT_S,
        f"exit code {service.process.returncode}": service.process.returncode != 0,
        "a traceback in the log": any(b"Traceback" in line for line in service.log),
    }


def kill_workers(service):
    """Kill the processes that compute: they give way to all others."""
    for child in Path(f"/proc/{service.process.pid}/task/{service.process.pid}/children").read_text().split():
        if os.getpriority(os.PRIO_PROCESS, int(child)) == WORKER_NICENESS:
            os.kill(int(child), signal.SIGKILL)


ENDINGS = {"verdict beside 60 diagnoses": lambda _: None, "verdict, workers killed": kill_workers}


def ended(case, program):
    """Let an experiment end by itself while others compute."""
    plc = Plc(program)
    with tempfile.TemporaryDirectory() as folder:
        service = Service(folder, plc, SHORT)
        try:
            with service.client() as client, under("queued diagnoses", service.port):
                tuning = client.post("/v1/loops/plc/tunings").raise_for_status().json()["links"]["self"]
                while client.get(tuning).json()["phase"] != "ended":
                    time.sleep(0.05)
                begun_s = time.monotonic()
                ENDINGS[case](service)
                while (told := client.get(tuning).json())[
                    "verdict"
                ] is None and time.monotonic() < begun_s + PATIENCE_S:
                    time.sleep(0.05)
                verdict_s, output = time.monotonic() - begun_s, plc.output()
                log, end_s = service.log_mb_a_minute(), service.end()
        finally:
            service.end()
            plc.close()
        outcome = (told["verdict"] or {}).get("outcome")
        failures = {
            f"the verdict is {told['verdict']}": outcome != "done",
            "the verdict was late": verdict_s > VERDICT_LIMIT_S,
            **failures_of_the_end(service, output, log, end_s),
        }
    numbers = f"{verdict_s:6.2f}  {'yes' if outcome == 'done' else 'no':6}  {output:6.1f}  {log:5.2f}  {end_s:5.1f}"
    return numbers, [what for what, failed in failures.items() if failed]


FREEZINGS = {"sensor freezes at the start": 0.0, "sensor freezes on its way": 4.0, "sensor freezes later": 15.0}
"""Moments after the beginning of the relay, s."""
PV_ROOM = 15.0
"""From the PV at rest to its limits; the oscillation swings by 4 to 6 about it."""


def frozen(case, program):
    """Freeze the sensor of the PLC; nobody else acts."""
    plc, failures = Plc(program), []
    limit_s = FROZEN_LIMIT_S if FREEZINGS[case] else SILENT_LIMIT_S
    rest = plc.ask()["y_true"]
    low, high = rest - PV_ROOM, rest + PV_ROOM
    with tempfile.TemporaryDirectory() as folder:
        service = Service(folder, plc, pv_limits=(low, high))
        try:
            with service.client() as client:
                tuning = client.post("/v1/loops/plc/tunings").raise_for_status().json()["links"]["self"]
                while client.get(tuning).json()["phase"] not in {"relay", "ended"}:
                    time.sleep(0.05)
                time.sleep(FREEZINGS[case])
                begun_s, pvs = time.monotonic(), [plc.ask("fault freeze 3600") and plc.ask()["y_true"]]
                while client.get(tuning).json()["phase"] != "ended" and time.monotonic() < begun_s + 2.0 * limit_s:
                    time.sleep(0.05)
                    pvs.append(plc.ask()["y_true"])
            frozen_s, output = time.monotonic() - begun_s, plc.output()
            log, end_s = service.log_mb_a_minute(), service.end()
        finally:
            service.end()
            plc.close()
    beyond = max(low - min(pvs), max(pvs) - high, 0.0)
    if frozen_s > limit_s:
        failures.append("noticed late")
    if beyond > max(pvs) - min(pvs):
        failures.append(f"{beyond:.1f} beyond its limit, and moved {max(pvs) - min(pvs):.1f}")
    if abs(output - OUTPUT) > NEAR:
        failures.append("the output was not restored")
    print(f"  (true PV {min(pvs):.1f} to {max(pvs):.1f}, limits {low:.1f} to {high:.1f})", file=sys.stderr)
    return f"{frozen_s:6.2f}  {'-':6}  {output:6.1f}  {log:5.2f}  {end_s:5.1f}", failures


LOSSES = {
    "tokens removed": lambda file: file.unlink(),
    "tokens moved": lambda file: file.rename(file.with_suffix(".old")),
    "tokens []": lambda file: file.write_text("[]"),
    "tokens {}": lambda file: file.write_text("{}"),
    "tokens unreadable": lambda file: (file.unlink(), file.mkdir()),
}


def closed(loss, program):  # noqa: C901 - a scenario
    """Take the tokens away while the service runs; nobody is let in, and the tuning goes on."""
    plc, failures = Plc(program), []
    with tempfile.TemporaryDirectory() as folder:
        secret = Tokens(Path(folder) / "data").add("engineer", Role.OPERATOR)
        service = Service(folder, plc)
        try:
            with service.client(Authorization=f"Bearer {secret}") as client:
                tuning = client.post("/v1/loops/plc/tunings").raise_for_status().json()["links"]["self"]
                while client.get(tuning).json()["phase"] != "relay":
                    time.sleep(0.2)
            file = Path(folder) / "data" / "tokens.json"
            LOSSES[loss](file)
            for headers in ({}, {"Authorization": f"Bearer {secret}"}):
                with service.client(**headers) as client:
                    for method, path in (("GET", "/v1/loops"), ("POST", "/v1/loops/plc/tunings"), ("GET", "/readyz")):
                        if (status := client.request(method, path).status_code) != 507:
                            failures.append(f"{method} {path}: {status}")
            time.sleep(1.0)
            if abs(plc.output() - OUTPUT) <= NEAR:
                failures.append("the tuning ended")
            end_s = service.end()
            output = plc.output()
        finally:
            service.end()
            plc.close()
    if abs(output - OUTPUT) > NEAR:
        failures.append("the output was not restored")
    if end_s > END_LIMIT_S:
        failures.append("the end was late")
    if sum(b"access is closed" in line for line in service.log) != 1:
        failures.append("the log does not say it once")
    return f"{'-':>6}  {'-':6}  {output:6.1f}  {service.log_mb_a_minute():5.2f}  {end_s:5.1f}", failures


KINDS = {overloaded: ATTACKS, ended: ENDINGS, frozen: FREEZINGS, closed: LOSSES}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", help="program of the PLC")
    conducted = {name: run for run, names in KINDS.items() for name in names}
    parser.add_argument("--case", nargs="*", choices=conducted, default=list(conducted))
    parser.add_argument("--attack", choices=ATTACKS, help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.attack:
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, hard), hard))
        with contextlib.suppress(TimeoutError):
            asyncio.run(asyncio.wait_for(ATTACKS[args.attack](args.port), 2 * PATIENCE_S))
        return 0
    failed = 0
    print(f"{'case':28}{'abort':>6}  {'tuning':6}  {'output':>6}  {'log':>5}  {'end':>5}  failed")
    for case in args.case:
        numbers, failures = conducted[case](case, args.peer)
        failed += bool(failures)
        print(f"{case:28}{numbers}  {'; '.join(failures) or '-'}", flush=True)
    print(f"{len(args.case)} cases, {failed} failed; load average {os.getloadavg()[0]:.0f}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
