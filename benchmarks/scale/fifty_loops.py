"""Fifty loops at once beside a page and twenty programs: are their samples late, is one lost, does memory grow?

    python benchmarks/scale/fifty_loops.py [--loops N] [--rate HZ] [--minutes M] [--clients N] [--no-browser]

All loops are tuned at once by one service in a process of its own, by a relay that goes on and on. A headless Chromium
has the live view of one of them open, where one is installed; else its stream of events is read. Each client asks once
a second for something else: loops, readings, a tuning, the list, the metrics. Told are, after the end: lateness of all
samples, periods missed, samples lost between recording and events, processor time of the service as a share of one
core, and its memory at the end of the first minute and at the end.
"""

import argparse
import contextlib
import importlib.util
import itertools
import json
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import httpx
import numpy as np

from benchmarks.scale._service import processor_s, service

PAGE = Path(__file__).resolve().parents[2] / "tests" / "page" / "browser.py"
SETTLED_S = 10.0
STARTED_S = 60.0
"""Until then browser, programs and workers are starting, which takes both cores of a small machine."""
ASKED = ("/v1/loops", "/v1/readings", "{tuning}", "/v1/tunings?limit=20", "/healthz", "{tuning}/recording?format=json")


@contextlib.contextmanager
def page(url, tuning, *, browser):
    """Keep the live view of a tuning open; yield what keeps it."""
    spec = importlib.util.spec_from_file_location("browser", PAGE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    program = module.find() if browser else None
    if program is None:
        with stream(url, tuning):
            yield "its stream alone"
        return
    with tempfile.TemporaryDirectory() as folder:
        opened = module.Browser(program, folder)
        opened.size(1280)
        opened.open(f"{url}/#/tunings/{tuning.rpartition('/')[2]}")
        opened.wait("document.querySelector('[data-phase=relay].now')", 120.0)
        yield "Chromium"
        seconds = opened.run("document.querySelector('.readout span').textContent")
        print(f"  the page is at {seconds}; it complained {len(opened.complaints())} times")
        opened.close()


@contextlib.contextmanager
def stream(url, tuning):
    stop = threading.Event()

    def read():
        with contextlib.suppress(httpx.HTTPError), httpx.stream("GET", f"{url}{tuning}/events", timeout=600.0) as lines:
            for _ in lines.iter_lines():
                if stop.is_set():
                    return

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    yield
    stop.set()


@contextlib.contextmanager
def clients(url, tunings, count):
    """Let so many programs ask once a second each; yield the statuses and times of their answers."""
    stop, answers = threading.Event(), []

    def ask(number):
        with httpx.Client(base_url=url, timeout=60.0) as client:
            for turn in itertools.count(number):
                path = ASKED[turn % len(ASKED)].format(tuning=tunings[turn % len(tunings)])
                begun = time.perf_counter()
                status = client.get(path).status_code
                answers.append((status, time.perf_counter() - begun))
                if stop.wait(1.0):
                    return

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    yield answers
    stop.set()
    for thread in threads:
        thread.join()


def memory_mib(process):
    (line,) = (row for row in Path(f"/proc/{process.pid}/status").read_text().splitlines() if row.startswith("VmRSS"))
    return int(line.split()[1]) / 1024.0


def stolen():
    """Return the processor time that the host of a virtual machine took away, and all of it, since its start."""
    times = [int(part) for part in Path("/proc/stat").read_text().split(maxsplit=9)[1:9]]
    return np.array([times[7], sum(times)])


def samples_of(client, tuning):
    """Return times and lateness of the samples that the events of a tuning tell, and how many the recording has."""
    text = client.get(f"{tuning}/events").text
    events = [json.loads(line[6:]) for line in text.splitlines() if line.startswith("data: ")]
    told = np.array([(event["t"], event["lateness_s"]) for event in events if event["type"] == "sample"])
    return told, client.get(tuning).json()["samples"]


def show(client, tunings, period_s):
    found = [samples_of(client, tuning) for tuning in tunings]
    lost = sum(count - len(told) for told, count in found)
    print(f"samples {sum(len(told) for told, _ in found)}, lost {lost}")
    for name, since_s in (("all", 0.0), ("after a minute", STARTED_S)):
        kept = [told[told[:, 0] >= since_s] for told, _ in found]
        lateness = 1e3 * np.concatenate([told[:, 1] for told in kept])
        if lateness.size:
            missed = sum(np.sum(np.round(np.diff(told[:, 0] - told[:, 1]) / period_s) - 1.0) for told in kept)
            p50, p99, p999, most = np.percentile(lateness, (50.0, 99.0, 99.9, 100.0))
            print(
                f"{name}: lateness p50 {p50:.2f}, p99 {p99:.2f}, p99.9 {p999:.2f}, max {most:.2f} ms;"
                f" periods missed {missed:.0f} ({missed / lateness.size:.3%})"
            )
    return sum(count for _, count in found)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loops", type=int, default=50)
    parser.add_argument("--rate", type=float, default=10.0, help="samples a second of each loop (10)")
    parser.add_argument("--minutes", type=float, default=3.0, help="(3)")
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--no-browser", action="store_true", help="read the stream instead")
    args = parser.parse_args()
    with service(args.loops, args.rate, requests_per_s=1000.0, politeness=20) as (client, process):
        url = str(client.base_url).rstrip("/")
        paths = [f"/v1/loops/loop-{number}/tunings" for number in range(args.loops)]
        tunings = [client.post(path).headers["location"] for path in paths]
        with page(url, tunings[0], browser=not args.no_browser) as what, clients(url, tunings, args.clients) as answers:
            time.sleep(SETTLED_S)
            begun, used_s, grown, taken = time.perf_counter(), processor_s(process), [], [stolen()]
            while time.perf_counter() - begun < 60.0 * args.minutes:
                time.sleep(5.0)
                grown.append((time.perf_counter() - begun, memory_mib(process)))
                taken.append(stolen())
            core = (processor_s(process) - used_s) / (time.perf_counter() - begun)
        times = 1e3 * np.array([took_s for _, took_s in answers])
        failed = sum(status >= 400 for status, _ in answers)
        ended = Counter(one["code"] for one in client.get("/v1/tunings").json()["tunings"] if one["code"])
        for tuning in tunings:
            client.post(f"{tuning}/abort")
        print(f"{args.loops} loops at {args.rate:g} Hz for {args.minutes:g} min, {args.clients} clients, page: {what}")
        print(f"tunings that ended before: {dict(ended) or 'none'}")
        count = show(client, tunings, 1.0 / args.rate)
        print(
            f"answers {times.size}, failed {failed}, p50 {np.median(times):.1f}, p99 {np.percentile(times, 99):.0f} ms"
        )
        late = [one for one in grown if one[0] >= min(60.0, grown[-1][0] / 2.0)]
        slope = (late[-1][1] - late[0][1]) / max(late[-1][0] - late[0][0], 1e-9)
        per_sample = 2**20 * slope / (args.loops * args.rate)
        grew = f"memory {late[0][1]:.0f} to {late[-1][1]:.0f} MiB, {per_sample:.0f} bytes a sample"
        print(f"service: {core:.1%} of a core; {grew}")
        shares = [steal / max(whole, 1) for steal, whole in np.diff(taken, axis=0)]
        print(
            f"taken by the host: {np.mean(shares):.1%} of the processors, at most {max(shares):.1%} over five seconds"
        )
        print(f"all {count} samples are held until their tunings are forgotten, events included")


if __name__ == "__main__":
    main()
