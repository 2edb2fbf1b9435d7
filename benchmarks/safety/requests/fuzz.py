"""Input that nobody made on purpose: requests, recordings and configurations of chance, against a served process.

    python benchmarks/safety/requests/fuzz.py [--requests 10000] [--csv 1000] [--toml 1000] [--seed N]

Requests are made from the OpenAPI document: each operation, with values that its schemas allow, others,
and bytes that are no JSON. Recordings are relay tests with coloured noise, wild values, other separators and damage;
they are identified and diagnosed by turns. Configurations are the examples with damage, checked by `autotuner check`.
The seed is a new one each time, and printed.

Required, exit code 1 otherwise: no answer 5xx other than 503 and 507, no traceback, no process that ends, and a peak
of the memory of the service with all of its processes under 256 MiB above what it takes after the first of each kind.
"""

import argparse
import concurrent.futures
import contextlib
import io
import json
import random
import secrets
import signal
import subprocess
import sys
import tempfile
import threading
import traceback
from collections import Counter
from pathlib import Path
from urllib.parse import quote

import httpx
import numpy as np

from autotuner.cli import main as command_line
from autotuner.service.openapi import document

MEMORY_LIMIT_MIB = 256.0
SAMPLED_S = 0.05
PATIENCE_S = 120.0
EXPECTED = {503, 507}
"""Answers of the server's kind that a client may meet: too much at once, and a disk that is full."""
KNOWN = {"loop": 0.8, "tuning_id": 0.1, "schedule_id": 0.1}
"""Share of the requests with a name that exists; a report or new gains of a tuning takes a second."""
CONFIGURATION = """
[service]
data_directory = "{folder}/data"
port = 0
requests_per_s = 1e6

[loops.heater]
driver = "simulated"
limits = {{ output = [0.0, 100.0], pv = [0.0, 250.0] }}
gains = {{ form = "ideal" }}
device = {{ plant = {{ structure = "fopdt", K = 2.0, T = 10.0, D = 1.5 }}, output0 = 40.0, pv0 = 80.0, noise = 0.05 }}
"""
ODD = [
    *(None, True, False, 0, -0.0, -1, 1, 2**31, -(2**63), 2**200, 1e-320, 1e308, -1e308, 0.1, 3.5, float("nan")),
    *(
        float("inf"),
        "",
        "0",
        "nan",
        "-inf",
        "a" * 5000,
        "\x00",
        "../../etc/passwd",
        "%00",
        "\u202e",
        "\U0001f525",
        "1e400",
    ),
    *(
        [],
        {},
        [[]],
        {"": None},
        [1.0, float("inf")],
        [0, 0],
        [[1, 2]] * 50,
        {"a": {"b": {"c": []}}},
        "heater",
        "tuning-1",
    ),
]
RAW = [
    b"",
    b"{",
    b"[" * 20_000,
    b'{"a":' * 5_000,
    rb'"\ud800"',
    b"\xff\xfe\x00",
    b"null",
    b"1e999",
    b'{"a":1,"a":2}',
    b"nan",
]


class Served:
    """A service in a process of its own, with its log and the memory of all of its processes."""

    def __init__(self, folder):
        file = Path(folder) / "loops.toml"
        file.write_text(CONFIGURATION.format(folder=folder))
        command = [sys.executable, "-m", "autotuner.cli", "serve", "--json", "--config", str(file)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)  # noqa: S603
        self.tracebacks, self._ended, self.peak_mib = [], threading.Event(), 0.0
        self._threads = [threading.Thread(target=one, daemon=True) for one in (self._read_log, self._watch)]
        for thread in self._threads:
            thread.start()
        self.url = json.loads(self.process.stdout.readline())["listening"]

    def _read_log(self):
        within = False
        for line in self.process.stderr:
            within = line.startswith((b" ", b"Traceback")) if within else b"Traceback" in line
            if within:
                self.tracebacks.append(line.decode(errors="replace").rstrip())

    def _watch(self):
        while not self._ended.wait(SAMPLED_S):
            self.peak_mib = max(self.peak_mib, self.memory_mib())

    def memory_mib(self):
        """Return what the process and its children take, shared pages by their share, MiB."""
        pid, total = self.process.pid, 0
        with contextlib.suppress(OSError):
            children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
            for one in (str(pid), *children):
                with contextlib.suppress(OSError, StopIteration):
                    lines = Path(f"/proc/{one}/smaps_rollup").read_text().splitlines()
                    total += int(next(line for line in lines if line.startswith("Pss:")).split()[1])
        return total / 1024.0

    def end(self):
        """Send SIGTERM; return the exit code."""
        self.process.send_signal(signal.SIGTERM)
        code = self.process.wait(PATIENCE_S)
        self._ended.set()
        for thread in self._threads:
            thread.join()
        return code


class Requests:
    """Requests made from the document."""

    def __init__(self, chance, known):
        self._chance, self._known, told = chance, known, json.loads(document())
        self._schemas = told["components"]["schemas"]
        self._operations = [
            (method.upper(), path, operation)
            for path, operations in told["paths"].items()
            for method, operation in operations.items()
            if "text/csv" not in operation.get("requestBody", {}).get("content", {})
        ]

    def make(self):
        """Return method, path, query, headers and body of one."""
        method, path, operation = self._chance.choice(self._operations)
        query, headers = {}, {}
        for one in operation.get("parameters", ()):
            value = self._text(self._value(one["schema"]))
            if one["in"] == "path":
                known = self._known[one["name"]]
                value = known if self._chance.random() < KNOWN[one["name"]] else value or "x"
                path = path.replace("{" + one["name"] + "}", quote(value[:500], safe=""))
            elif self._chance.random() < 0.6:
                (query if one["in"] == "query" else headers)[one["name"]] = value
        return method, path, query, {k: ascii(v)[:200] for k, v in headers.items()}, self._body(operation)

    def _body(self, operation):
        content = operation.get("requestBody", {}).get("content", {}).get("application/json")
        if content is None or self._chance.random() < 0.1:
            return self._chance.choice(RAW) if self._chance.random() < 0.2 else b""
        if self._chance.random() < 0.1:
            return self._chance.choice(RAW)
        body = json.dumps(self._value(content["schema"])).encode()
        if self._chance.random() < 0.1 and body:
            place = self._chance.randrange(len(body))
            body = body[:place] + bytes([self._chance.randrange(256)]) + body[place + 1 :]
        return body

    def _value(self, schema, depth=0):  # noqa: C901, PLR0911 - a case of each kind
        chance = self._chance
        if chance.random() < 0.15 or depth > 6:
            return chance.choice(ODD)
        if "$ref" in schema:
            return self._value(self._schemas[schema["$ref"].rpartition("/")[2]], depth + 1)
        if options := schema.get("anyOf") or schema.get("oneOf") or schema.get("allOf"):
            return self._value(chance.choice(options), depth + 1)
        if "enum" in schema:
            return chance.choice(schema["enum"])
        match schema.get("type"):
            case "object":
                named = {
                    k: self._value(v, depth + 1)
                    for k, v in schema.get("properties", {}).items()
                    if chance.random() < 0.4
                }
                return named | ({"extra": chance.choice(ODD)} if chance.random() < 0.05 else {})
            case "array":
                return [self._value(schema.get("items", {}), depth + 1) for _ in range(chance.randrange(4))]
            case "number" | "integer":
                return chance.choice([chance.uniform(-10, 1000), 10 ** chance.uniform(-12, 12), chance.randrange(100)])
            case "boolean":
                return chance.random() < 0.5
            case "null":
                return None
        return "".join(chance.choices("abc heater-1\"'\\\n<&é", k=chance.randrange(12)))

    def _text(self, value):
        return value if isinstance(value, str) else json.dumps(value)


class Recordings:
    """Relay tests with coloured noise, wild values and damage."""

    def __init__(self, seed):
        self._draw = np.random.default_rng(seed)

    def make(self):
        """Return a CSV file."""
        draw = self._draw
        count, step = (
            int(draw.integers(40, 400) if draw.random() < 0.9 else draw.integers(0, 40)) + 1,
            10.0 ** draw.uniform(-3, 3),
        )
        half = int(draw.integers(2, 60))
        t = np.arange(count) * step + (draw.uniform(0, step, count) if draw.random() < 0.3 else 0.0)
        u = np.where(np.arange(count) // half % 2 == 0, 50.0, 30.0) * 10.0 ** draw.uniform(-3, 3)
        y, noise = np.zeros(count), 0.0
        lag, gain, level = draw.uniform(0.5, 2 * half), draw.normal(), draw.normal() * 100
        colour, sigma = draw.uniform(0, 0.999), 10.0 ** draw.uniform(-6, 1)
        for k in range(1, count):
            noise = colour * noise + sigma * draw.standard_normal()
            y[k] = y[k - 1] + (gain * u[k - 1] - y[k - 1]) / lag
            y[k] += noise if draw.random() < 0.5 else 0.0
        columns = np.column_stack((t, u, y + level))
        for _ in range(int(draw.integers(1, 4)) if draw.random() < 0.25 else 0):
            columns[draw.integers(count), draw.integers(3)] = draw.choice(
                [np.nan, np.inf, -np.inf, 1e308, -1e308, 1e300, 5e-324, 2.0**63, 1e22, 0.0]
            )
        if draw.random() < 0.1:
            with np.errstate(over="ignore"):
                columns[:, draw.integers(3)] *= 10.0 ** draw.uniform(-300, 300)
        return self._written(columns)

    def _written(self, columns):
        draw = self._draw
        separator = str(draw.choice([",", ",", ",", ";", "\t"]))
        head = str(draw.choice(["t,u,y"] * 20 + ["time,output,pv", "t,u,y,sp", "", "y,u,t", "t;u;y"])).replace(
            ",", separator
        )
        digits = 17, int(draw.integers(1, 18)), int(draw.integers(1, 18))
        rows = [separator.join(f"{value:.{n}g}" for value, n in zip(row, digits, strict=True)) for row in columns]
        text = "\n".join([head, *rows]).encode()
        for _ in range(int(draw.integers(1, 8)) if draw.random() < 0.2 else 0):
            place = int(draw.integers(len(text)))
            wild = [
                b"",
                b"\x00",
                b'"',
                b"\xff",
                b"e999",
                b"9" * 400,
                b"\r",
                b",,,,",
                b"#",
                "\u2212".encode(),
                b"NaN",
                b"=1+1",
            ]
            text = text[:place] + wild[draw.integers(len(wild))] + text[place + int(draw.integers(0, 3)) :]
        return text


def damaged(text, chance):
    """Return a configuration with some damage."""
    for _ in range(chance.choice((1, 1, 2, 5))):
        place, other = chance.randrange(len(text) + 1), chance.randrange(len(text) + 1)
        odd = json.dumps(chance.choice(ODD), default=str)
        wild = [
            odd,
            "[" * 3000,
            "a." * 3000,
            "{x=" * 2000,
            "9" * 5000,
            "\x00",
            '"',
            "=",
            "\n[[loops]]\n",
            "-inf",
            "1979-05-27",
            "'''",
        ]
        match chance.randrange(4):
            case 0:
                text = text[:place] + chance.choice(wild) + text[place:]
            case 1:
                text = text[: min(place, other)] + text[min(place, other) + chance.randrange(40) :]
            case 2:
                text = text[:place] + text[other : other + 200] + text[place:]
            case _:
                lines = text.split("\n")
                k = chance.randrange(len(lines))
                key = lines[k].partition("=")[0]
                lines[k] = f"{key}= {chance.choice(wild[:5])}"
                text = "\n".join(lines)
    return text


def configurations(count, chance):
    """Check configurations; return exit codes and what was neither accepted nor refused."""
    root, codes, broken = Path(__file__).parents[3], Counter(), []
    examples = [
        file.read_text() for folder in ("examples", "docker") for file in sorted((root / folder).rglob("*.toml"))
    ]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "loops.toml"
        for _ in range(count):
            text = damaged(chance.choice(examples), chance)
            file.write_text(text, errors="surrogatepass")
            try:
                with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
                    codes[command_line(["check", str(file)])] += 1
            except SystemExit as end:
                codes[end.code] += 1
            except BaseException:  # noqa: BLE001 - whatever it is, it is what is looked for
                broken.append(f"{traceback.format_exc()[-600:]}\n{text[:300]!r}")
    return codes, broken


def send(served, client, request):
    """Send a request; return its status, None where the client itself could not send it."""
    method, path, query, headers, body = request
    kind = {"Content-Type": "application/json"} if body else {}
    try:
        with client.stream(method, path, params=query, headers=headers | kind, content=body or None) as answer:
            if "event-stream" not in answer.headers.get("content-type", ""):
                answer.read()
            return answer.status_code
    except (httpx.InvalidURL, UnicodeEncodeError, httpx.LocalProtocolError):
        return None
    except httpx.HTTPError as error:
        return f"{type(error).__name__}, {served.process.poll()}"


def fuzz(served, args, chance):
    """Send all; return statuses by kind and what is wrong."""
    statuses, wrong = {"requests": Counter(), "csv": Counter()}, []
    recordings = Recordings(args.seed)
    with httpx.Client(base_url=served.url, timeout=PATIENCE_S) as client:
        tuning = client.post("/v1/loops/heater/tunings").json()["id"]
        requests = Requests(chance, {"loop": "heater", "tuning_id": tuning, "schedule_id": "none"})

        def upload(k, content):
            path = "/v1/identifications" if k % 3 else "/v1/diagnoses"
            return send(served, client, ("POST", path, {}, {"content-type": "text/csv"}, content)), path, content

        for k in range(4):  # what the first of each kind loads is no growth
            upload(k, recordings.make())
        start_mib = served.memory_mib()
        served.peak_mib = start_mib
        for _ in range(args.requests):
            request = requests.make()
            status = send(served, client, request)
            statuses["requests"][status] += 1
            if isinstance(status, str) or (status and status >= 500 and status not in EXPECTED):
                wrong.append(f"{status} {request}"[:600])
        with concurrent.futures.ThreadPoolExecutor(2) as two:
            for status, path, content in two.map(upload, range(args.csv), (recordings.make() for _ in range(args.csv))):
                statuses["csv"][status] += 1
                if isinstance(status, str) or (status and status >= 500 and status not in EXPECTED):
                    wrong.append(f"{status} {path} {content[:300]!r}")
    return statuses, wrong, start_mib


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, default=10_000)
    parser.add_argument("--csv", type=int, default=1000)
    parser.add_argument("--toml", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10**9))
    args = parser.parse_args()
    print(f"--seed {args.seed}", flush=True)
    chance = random.Random(args.seed)  # noqa: S311 - no secrets
    with tempfile.TemporaryDirectory() as folder:
        served = Served(folder)
        try:
            statuses, wrong, start_mib = fuzz(served, args, chance)
        finally:
            code = served.end()
    codes, broken = configurations(args.toml, chance)
    for kind, count in statuses.items():
        print(f"{kind:10} {count.total():6d}  {dict(sorted(count.items(), key=str))}")
    print(f"toml       {args.toml:6d}  by exit code {dict(codes)}, not refused in words: {len(broken)}")
    above = served.peak_mib - start_mib
    print(f"memory     {start_mib:.0f} MiB at the start, {above:+.0f} MiB at its peak (limit {MEMORY_LIMIT_MIB:g})")
    failed = [*wrong, *served.tracebacks, *broken, *([f"exit code {code}"] if code else [])]
    print(f"{len(failed)} wrong" + "".join(f"\n{text}" for text in failed[:40]))
    sys.exit(bool(failed) or above > MEMORY_LIMIT_MIB)


if __name__ == "__main__":
    main()
