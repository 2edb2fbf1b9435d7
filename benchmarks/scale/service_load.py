"""How late the samples of running tunings come while the service is kept busy by others.

    python benchmarks/scale/service_load.py [--loops N] [--rate HZ] [--seconds S] [--readers N] [--requests N]
                                            [--rows N]

N simulated loops are tuned at once by a service in a process of its own: first alone, then with readers of the live
events of one of them, then with clients that ask for results as fast as they are answered, at most N a second, then
while a recording is uploaded and identified. For each part: lateness of the samples taken in it, periods missed, and
processor time of the service (its workers not counted) as a share of one core.
"""

import argparse
import contextlib
import json
import threading
import time

import httpx
import numpy as np

from benchmarks.scale._service import processor_s, service

SETTLED_S = 3.0


def recording(rows):
    """Return the CSV of an output that moves in steps and a PV that does not answer to it."""
    lines = (f"{0.1 * i:.1f},{40 + 10 * (i // 50 % 2)},{80 + i % 97 * 0.1:.1f}" for i in range(rows))
    return "\n".join(["t,u,y", *lines]).encode()


def read(client, path, stop):
    with contextlib.suppress(httpx.HTTPError), client.stream("GET", f"{path}/events") as stream:
        for _ in stream.iter_lines():
            if stop.is_set():
                return


@contextlib.contextmanager
def readers(client, path, count):
    stop = threading.Event()
    threads = [threading.Thread(target=read, args=(client, path, stop)) for _ in range(count)]
    for thread in threads:
        thread.start()
    yield
    stop.set()
    for thread in threads:
        thread.join()


@contextlib.contextmanager
def requests(client, path, rate):
    stop, answered = threading.Event(), []

    def ask():
        begun = time.perf_counter()
        while not stop.is_set():
            client.get(path)
            answered.append(None)
            stop.wait(max(0.0, begun + len(answered) / rate - time.perf_counter()))

    thread = threading.Thread(target=ask)
    thread.start()
    begun = time.perf_counter()
    yield
    took_s = time.perf_counter() - begun
    stop.set()
    thread.join()
    print(f"  {len(answered) / took_s:.0f} requests/s answered")


def upload(client, rows):
    body = recording(rows)
    begun = time.perf_counter()
    answer = client.post("/v1/identifications", content=body, headers={"Content-Type": "text/csv"})
    print(f"  upload of {len(body) / 2**20:.1f} MiB: {answer.status_code} after {time.perf_counter() - begun:.1f} s")


class Parts:
    """Which samples belong to which part of the run."""

    def __init__(self, client, process, paths):
        self._client, self._process, self._paths = client, process, paths
        self._parts = []

    def _taken(self):
        return [self._client.get(path).json()["samples"] for path in self._paths]

    @contextlib.contextmanager
    def part(self, name):
        before, used_s, begun = self._taken(), processor_s(self._process), time.perf_counter()
        yield
        core = (processor_s(self._process) - used_s) / (time.perf_counter() - begun)
        self._parts.append((name, before, self._taken(), core))

    def show(self, period_s):
        samples = [self._samples(path) for path in self._paths]
        print(f"{'part':12} {'samples':>8} {'p50':>8} {'p99':>8} {'p99.9':>8} {'max, ms':>8} {'missed':>8} {'core':>6}")
        for name, before, after, core in self._parts:
            kept = [s[a:b] for s, a, b in zip(samples, before, after, strict=True)]
            lateness = 1e3 * np.concatenate([s[:, 1] for s in kept])
            missed = sum(float(np.sum(np.round(np.diff(s[:, 0] - s[:, 1]) / period_s) - 1.0)) for s in kept)
            told = " ".join(f"{v:8.2f}" for v in [*np.percentile(lateness, (50.0, 99.0, 99.9)), lateness.max()])
            print(f"{name:12} {lateness.size:8d} {told} {missed / lateness.size:8.3%} {core:6.1%}")

    def _samples(self, path):
        text = self._client.get(f"{path}/events").text
        events = [json.loads(line[6:]) for line in text.splitlines() if line.startswith("data: ")]
        return np.array([(e["t"], e["lateness_s"]) for e in events if e["type"] == "sample"])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loops", type=int, default=1)
    parser.add_argument("--rate", type=float, default=10.0, help="samples a second of each loop (10)")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each part (10)")
    parser.add_argument("--readers", type=int, default=20)
    parser.add_argument("--requests", type=float, default=200.0, help="a second, of one client (200)")
    parser.add_argument("--rows", type=int, default=300_000, help="of the uploaded recording; 0: none")
    args = parser.parse_args()
    with service(args.loops, args.rate, requests_per_s=100000.0, politeness=10) as (client, process):
        loops = [f"/v1/loops/loop-{number}/tunings" for number in range(args.loops)]
        paths = [client.post(loop).headers["location"] for loop in loops]
        time.sleep(SETTLED_S)
        parts = Parts(client, process, paths)
        with parts.part("alone"):
            time.sleep(args.seconds)
        with readers(client, paths[0], args.readers), parts.part("readers"):
            time.sleep(args.seconds)
        with requests(client, paths[0], args.requests), parts.part("requests"):
            time.sleep(args.seconds)
        if args.rows:
            with parts.part("upload"):
                upload(client, args.rows)
        for path in paths:
            client.post(f"{path}/abort")
        parts.show(1.0 / args.rate)


if __name__ == "__main__":
    main()
