"""How late the samples of a loop come while the same service answers requests, beside `cyclictest`.

    python benchmarks/latency/beside_requests.py [--rates HZ ...] [--requests N] [--seconds S] [--rounds N]
                                                 [--path PATH ...]

`autotuner serve`, in a process of its own, tunes one simulated loop; another process asks it N times a second for what
the page asks for while a tuning runs. In turns, each under the same requests, and nothing else is measured meanwhile:

call_at       a control loop by `loop.call_at` on the event loop of a web service that answers as many requests
usual         the service as it is configured by default, without privileges: the loop process of all simulated loops
own process   the same with `own_process` in the loop's table
real time     the service with `service.real_time`, which needs CAP_SYS_NICE, and a process for the loop; left out where
              that is missing
cyclictest    the limit: `cyclictest` of rt-tests at the same priority, or, where that is not installed, a thread that
              does nothing but sleep, while the service answers requests and tunes nothing

Printed: lateness of the deadlines met, how many were missed by a whole period, and how many requests were answered.
"""

import argparse
import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx
import numpy as np

from benchmarks.latency._asker import asked

SETTLED_S = 1.0
PRIORITY = 50
LOOP = """
[loops.at-{rate:g}]
driver = "simulated"
sample_time_s = {period_s:g}
own_process = {own_process}
relay = {{ amplitude = 10.0, min_periods = 500, max_periods = 1000, hysteresis = 5.0 }}
device.plant = {{ structure = "fopdt", K = 2.0, T = 2000.0, D = 300.0 }}
device.output0 = 40.0
device.pv0 = 80.0
device.noise = 0.05
"""
PATHS = ("/v1/tunings/{id}", "/v1/loops", "/healthz")
WEB = """
import sys, uvicorn, fastapi
from benchmarks.latency.lateness import called_at
app = fastapi.FastAPI()
@app.get("/measured/{rate}/{seconds}")
async def measured(rate: float, seconds: float):
    return await called_at(1.0 / rate, seconds)
@app.get("/{rest:path}")
async def anything(rest: str):
    return {"status": "ok", "path": rest, "numbers": list(range(100))}
uvicorn.run(app, port=int(sys.argv[1]), log_config=None)
"""


@contextlib.contextmanager
def served(words, url=None):
    """Yield a client of a service in a process of its own; without `url`, its first line tells that."""
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)  # noqa: S603
    try:
        if url is None:
            url = json.loads(process.stdout.readline())["listening"]
        with httpx.Client(base_url=url, timeout=60.0) as client:
            until_answered(client)
            yield client
    finally:
        process.terminate()
        try:
            process.communicate(timeout=20.0)
        finally:
            process.kill()


def until_answered(client):
    while True:
        with contextlib.suppress(httpx.TransportError):
            if client.get("/healthz").status_code == 200:
                return
        time.sleep(0.05)


def configuration(folder, rates, *, real_time, own_process=True):
    """Return what serves such loops."""
    file = Path(folder) / f"{real_time:d}{own_process:d}.toml"
    own = str(own_process).lower()
    table = f'[service]\ndata_directory = "{folder}/{file.stem}"\nrequests_per_s = 100000.0\n'
    table += f"real_time = {PRIORITY}\n" if real_time else ""
    file.write_text(table + "".join(LOOP.format(rate=rate, period_s=1.0 / rate, own_process=own) for rate in rates))
    return [sys.executable, "-m", "autotuner", "serve", "--json", "--port", "0", "--config", str(file)]


def tuned(client, rate, args):
    """Return lateness, s, of the samples of a tuning under requests, periods missed, and requests answered a second."""
    tuning = client.post(f"/v1/loops/at-{rate:g}/tunings").json()["id"]
    time.sleep(SETTLED_S)
    before = client.get(f"/v1/tunings/{tuning}").json()["samples"]
    paths = [path.format(id=tuning) for path in args.path]
    answered = asked(str(client.base_url), paths, args.requests, args.seconds)
    after = client.get(f"/v1/tunings/{tuning}").json()["samples"]
    client.post(f"/v1/tunings/{tuning}/abort")
    lines = client.get(f"/v1/tunings/{tuning}/events").text.splitlines()
    events = [json.loads(line[6:]) for line in lines if line.startswith("data: ")]
    told = np.array([(e["t"], e["lateness_s"]) for e in events if e["type"] == "sample"])[before:after]
    assert len(told), events[-1]
    due = np.round((told[:, 0] - told[:, 1]) * rate)
    return told[:, 1], int(due[-1] - due[0]) + 1 - due.size, answered


def web(client, rate, args):
    """Return the same of `call_at` beside the requests of a web service."""
    asking = asked(str(client.base_url), ["/a", "/b", "/healthz"], args.requests, args.seconds, wait=False)
    late = np.array(client.get(f"/measured/{rate}/{args.seconds}").json())
    return late, max(round(args.seconds * rate) - late.size, 0), asking()


def limit(client, rate, args):
    """Return the same of `cyclictest`; the service has nothing but requests."""
    asking = asked(str(client.base_url), ["/v1/loops", "/healthz"], args.requests, args.seconds, wait=False)
    words = ["cyclictest", "-q", "-m", f"-p{PRIORITY}", "-t1", f"-i{1e6 / rate:.0f}", f"-D{args.seconds:.0f}"]
    told = subprocess.run([*words, "-h20000"], capture_output=True, text=True, check=True).stdout  # noqa: S603
    counts = [(int(us), int(n)) for us, n in re.findall(r"^(\d+) (\d+)$", told, re.MULTILINE)]
    late = 1e-6 * np.repeat(*np.array(counts).T)
    return late, int((late > 1.0 / rate).sum()), asking()


def slept(client, rate, args):
    from benchmarks.latency.lateness import slept as bare  # noqa: PLC0415 - only where there is no cyclictest

    asking = asked(str(client.base_url), ["/v1/loops", "/healthz"], args.requests, args.seconds, wait=False)
    late = np.array(bare(1.0 / rate, args.seconds))
    return late, max(round(args.seconds * rate) - late.size, 0), asking()


def may_be_real_time():
    """Return whether this process may ask for the real-time class."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except (AttributeError, OSError):
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


@contextlib.contextmanager
def ways(args):
    """Yield what is measured, by name."""
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        found = {}
        words = [sys.executable, "-c", WEB, str(args.port)]
        naive = stack.enter_context(served(words, f"http://127.0.0.1:{args.port}"))
        found["call_at"] = lambda rate: web(naive, rate, args)
        words = configuration(folder, args.rates, real_time=False, own_process=False)
        usual = stack.enter_context(served(words))
        found["usual"] = lambda rate: tuned(usual, rate, args)
        own = stack.enter_context(served(configuration(folder, args.rates, real_time=False)))
        found["own process"] = lambda rate: tuned(own, rate, args)
        if may_be_real_time():
            fifo = stack.enter_context(served(configuration(folder, args.rates, real_time=True)))
            found["real time"] = lambda rate: tuned(fifo, rate, args)
        if shutil.which("cyclictest") and may_be_real_time():
            found["cyclictest"] = lambda rate: limit(usual, rate, args)
        else:
            found["bare thread"] = lambda rate: slept(usual, rate, args)
        yield found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=float, nargs="+", default=[100.0, 1000.0], help="samples a second")
    parser.add_argument("--requests", type=float, default=200.0, help="a second (200)")
    parser.add_argument("--seconds", type=float, default=5.0, help="of one way at a time (5)")
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--path", nargs="+", default=PATHS, help="what is asked for in turns; {id} is the tuning")
    parser.add_argument("--port", type=int, default=8397, help="of the service that `call_at` runs in")
    args = parser.parse_args()
    kept = {}
    with ways(args) as found:
        for _ in range(args.rounds):
            for rate in args.rates:
                for name, way in found.items():
                    kept.setdefault((rate, name), []).append(way(rate))
    print(
        f"{'':12} {'Hz':>5} {'met':>7} {'p50':>8} {'p90':>8} {'p99':>8} {'max, us':>8} {'missed':>8} {'requests/s':>11}"
    )
    for (rate, name), parts in sorted(kept.items(), key=lambda item: item[0][0]):
        late = 1e6 * np.maximum(np.concatenate([late for late, _, _ in parts]), 0.0)
        told = " ".join(f"{v:8.0f}" for v in [*np.percentile(late, (50.0, 90.0, 99.0)), late.max()])
        missed = sum(count for _, count, _ in parts)
        answered = np.mean([count for _, _, count in parts])
        share = missed / (late.size + missed)
        print(f"{name:12} {rate:5.0f} {late.size:7d} {told} {share:8.3%} {answered:11.0f}")


if __name__ == "__main__":
    main()
