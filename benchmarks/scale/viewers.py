"""What many viewers of one loop cost the service, with each event sent by itself and with events of a moment together.

    python benchmarks/scale/viewers.py [--viewers N] [--rate HZ] [--seconds S] [--rounds N]

A service in a process of its own runs one simulated tuning; N readers of its live events are connected, all in another
process. In turns within one run, processor time of the service (its workers not counted), less that of the same
service with nobody watching, per viewer and event:

each by himself  the framework's own `EventSourceResponse`: a generator a viewer that encodes what is new
the service      `/v1/tunings/{id}/events`
limit            bytes that are there already, written to as many sockets by a process that does nothing else
"""

import argparse
import asyncio
import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from urllib.parse import urlsplit

import httpx

LOOP = """
[service]
data_directory = "{folder}/data"
requests_per_s = 100000.0
connections_limit = 1000
[loops.watched]
driver = "simulated"
sample_time_s = {period_s:g}
relay = {{ amplitude = 10.0, min_periods = 500, max_periods = 1000, hysteresis = 5.0 }}
device = {{ plant = {{ structure = "fopdt", K = 2.0, T = 200.0, D = 30.0 }}, output0 = 40.0, pv0 = 80.0, noise = 0.05 }}
"""
EACH = "/each/{tuning_id}"
SETTLED_S = 1.0
EVENT_BYTES = 230


async def each_by_himself(tuning, last_event_id):
    from fastapi.sse import ServerSentEvent  # noqa: PLC0415 - in the service's process only

    seen = last_event_id + 1
    while not tuning.end_published:
        news = tuning.events[seen:]
        for index, event in enumerate(news, seen):
            yield ServerSentEvent(data=event.to_dict(), event=event.type, id=str(index))
        seen += len(news)
        await tuning.more(seen)


def serve(words):
    """Serve with one more path, at which each viewer is sent to by himself."""
    from fastapi.sse import EventSourceResponse  # noqa: PLC0415 - in the service's process only

    from autotuner.cli import main as command  # noqa: PLC0415
    from autotuner.service.context import SeenOf  # noqa: PLC0415
    from autotuner.service.events import live  # noqa: PLC0415

    @live.router.get(EACH, response_class=EventSourceResponse)  # type: ignore[untyped-decorator]
    async def each(tuning: SeenOf, last_event_id: live.LastSeen = -1):
        async for event in each_by_himself(tuning, last_event_id):
            yield event

    return command(words)


def watch(url, path, count, begin, seconds):
    """Read what comes by many connections, and count the events; for a process of its own."""
    where = urlsplit(url)
    head = f"GET {path} HTTP/1.1\r\nHost: {where.netloc}\r\nLast-Event-ID: {begin}\r\n\r\n".encode()
    lines = [socket.create_connection((where.hostname, where.port)) for _ in range(count)]
    for line in lines:
        line.sendall(head)
    ready = threading.Event()
    counts = [0] * count

    def read(number):
        while data := lines[number].recv(65536):
            if ready.is_set():
                counts[number] += data.count(b"event: ")

    for number in range(count):
        threading.Thread(target=read, args=(number,), daemon=True).start()
    time.sleep(SETTLED_S)
    ready.set()
    print("watching", flush=True)
    time.sleep(seconds)
    print(sum(counts), flush=True)
    os._exit(0)


def spent_s(pid):
    """Return processor time of a process, s, to the nanosecond."""
    return 1e-9 * sum(int(file.read_text().split()[0]) for file in Path(f"/proc/{pid}/task").glob("*/schedstat"))


def watched(pid, words, seconds):
    """Return processor time, s, of the service while it is watched, and how many events arrived."""
    words = [sys.executable, __file__, "--watch", *map(str, words), str(seconds)]
    reader = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)  # noqa: S603 - ourselves
    reader.stdout.readline()
    before = spent_s(pid)
    time.sleep(seconds - 0.1)
    used = (spent_s(pid) - before) * seconds / (seconds - 0.1)
    return used, int(reader.communicate()[0])


def unwatched(pid, seconds):
    before = spent_s(pid)
    time.sleep(seconds)
    return spent_s(pid) - before


async def write(rate, seconds, size):
    """Write so many bytes so often to all who connect; for a process of its own."""
    joined = []

    class Taken(asyncio.Protocol):
        def connection_made(self, transport):
            joined.append(transport)

    server = await asyncio.get_running_loop().create_server(Taken, "127.0.0.1", 0)
    print(json.dumps({"listening": f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"}), flush=True)
    begun, body = time.monotonic(), b"event: " + b"x" * (size - 7)
    while time.monotonic() - begun < 5.0 * SETTLED_S + seconds:
        for transport in joined:
            transport.write(body)
        await asyncio.sleep(1.0 / rate)


def written(count, rate, seconds):
    """Return processor time, s, of writing what is there already, and how many events arrived."""
    words = [sys.executable, __file__, "--write", *map(str, (rate, seconds, EVENT_BYTES))]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)  # noqa: S603 - ourselves
    try:
        url = json.loads(process.stdout.readline())["listening"]
        return watched(process.pid, (url, "/", count, -1), seconds)
    finally:
        process.kill()
        process.communicate()


@contextlib.contextmanager
def tuning(rate):
    """Yield address and process of a service, and a tuning that goes on."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "loops.toml"
        file.write_text(LOOP.format(folder=folder, period_s=1.0 / rate))
        words = [sys.executable, __file__, "--serve", "serve", "--json", "--port", "0", "--config", str(file)]
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen(words, text=True, **streams)  # noqa: S603 - ourselves
        try:
            url = json.loads(process.stdout.readline())["listening"]
            begun = httpx.post(f"{url}/v1/loops/watched/tunings", timeout=30.0).json()["id"]
            time.sleep(SETTLED_S)
            yield url, process.pid, begun
        finally:
            process.terminate()
            try:
                process.communicate(timeout=20.0)
            finally:
                process.kill()


def main():
    if sys.argv[1:2] == ["--serve"]:
        return serve(sys.argv[2:])
    if sys.argv[1:2] == ["--watch"]:
        url, path, count, begin, seconds = sys.argv[2:]
        return watch(url, path, int(count), int(begin), float(seconds))
    if sys.argv[1:2] == ["--write"]:
        rate, seconds, size = map(float, sys.argv[2:])
        return asyncio.run(write(rate, seconds, int(size)))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--viewers", type=int, default=50)
    parser.add_argument("--rate", type=float, default=20.0, help="samples a second of the loop (20)")
    parser.add_argument("--seconds", type=float, default=4.0, help="of one way at a time (4)")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    found = {"each by himself": [], "the service": [], "limit": []}
    with tuning(args.rate) as (url, pid, begun):
        paths = {"each by himself": EACH.format(tuning_id=begun), "the service": f"/v1/tunings/{begun}/events"}
        for _ in range(args.rounds):
            alone_s = unwatched(pid, args.seconds)
            for name, path in paths.items():
                seen = httpx.get(f"{url}/v1/tunings/{begun}").json()["samples"]
                used, events = watched(pid, (url, path, args.viewers, seen), args.seconds)
                found[name].append((used - alone_s, events))
            found["limit"].append(written(args.viewers, args.rate, args.seconds))
    what = f"{args.viewers} viewers, {args.rate:g} events/s"
    print(f"{what:26} {'us a viewer and event':>24} {'times less':>11} {'events':>8}")
    us = {name: 1e6 * sum(used for used, _ in rows) / sum(n for _, n in rows) for name, rows in found.items()}
    for name, rows in found.items():
        times = us["each by himself"] / us[name]
        print(f"{name:26} {us[name]:24.1f} {times:11.1f} {sum(n for _, n in rows):8d}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
