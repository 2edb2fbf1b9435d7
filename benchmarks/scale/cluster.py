"""What a Dask cluster of two local workers gains, and what a worker that is killed costs.

    python benchmarks/scale/cluster.py [--files N] [--chunks N] [--rounds N]

Batch diagnosis of simulated recordings (`autotuner diagnose FILE... --json --dask ADDRESS`) and training data
(`autotuner_models.learned.generation`), each by one worker, by two, and by two of which one is killed (SIGKILL) in the
middle, with the scheduler and the workers in processes of their own. Printed: the time, how many times faster than one
worker, what that is of the limit, and whether the results are the same to the last byte. The limit is the same work by
two processes that share nothing, begun at once, in the same round: what the machine's two cores give.

A worker has one thread, one thread of BLAS, and Dask's profiler, which looks at its stack every 10 ms, is off.
"""

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import threading
import time
from importlib import import_module
from pathlib import Path

import numpy as np

from autotuner.core.recording import Recording
from autotuner_models.learned.generation import Plan, generate
from autotuner_sim import Fopdt, run_relay, symmetric_relay

SAMPLES = 600
QUIET = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "DASK_LOGGING__DISTRIBUTED": "critical"}
QUIET["DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED"] = "false"
MAKE = "import sys; from benchmarks.scale.cluster import made; made(int(sys.argv[1]), None)"


@contextlib.contextmanager
def cluster(workers):
    """Yield the address of a scheduler, and its workers' processes."""
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder) / "scheduler.json"
        words = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
        dask = [start([*words, "--scheduler-file", str(told)], folder)]
        words = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(told), "--no-dashboard"]
        words += ["--nthreads", "1", "--no-nanny", "--memory-limit", "0"]
        dask += [start(words, folder) for _ in range(workers)]
        try:
            import distributed  # noqa: PLC0415 - an extra

            while not told.exists():
                time.sleep(0.05)
            with distributed.Client(scheduler_file=str(told)) as client:
                client.wait_for_workers(workers)
                client.run(warm)
                address = client.scheduler.address
            yield address, dask[1:]
        finally:
            for process in dask:
                process.kill()
                process.wait()


def start(words, folder):
    return subprocess.Popen(words, cwd=folder, env=QUIET, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # noqa: S603


def warm():
    """Import, in a worker, what both kinds of work need."""
    for name in ("scipy.optimize", "autotuner.core.diagnosis.procedure", "autotuner_models.learned.generation"):
        import_module(name)


def recordings(folder, count):
    """Write relay records of different processes."""
    files = []
    for number in range(count):
        T = 8.0 + number
        run = run_relay(Fopdt(2.0, T, T / 5.0), symmetric_relay(5.0), 1e6, max_switches=16)
        times = np.linspace(0.0, run.times_s[-1], SAMPLES)
        noise = 0.02 * np.random.default_rng(number).standard_normal(SAMPLES)
        recording = Recording(times, run.output(times), run.pv(times) + noise)
        files.append(folder / f"{number}.csv")
        files[-1].write_text(recording.to_csv())
    return files


def diagnosed(files, address):
    words = [sys.executable, "-m", "autotuner", "diagnose", "--json", *map(str, files)]
    words += [] if address is None else ["--dask", address]
    return subprocess.run(words, check=True, capture_output=True, env=QUIET).stdout  # noqa: S603 - ourselves


def made(chunks, address):
    with tempfile.TemporaryDirectory() as folder:
        return generate(Plan(7, chunks), Path(folder), 1, address, lambda _done, _of: None)[1].encode()


def timed(work, address, victim=None, after_s=0.0):
    """Return time and result; `victim` is killed on the way."""
    if victim is not None:
        threading.Timer(after_s, victim.kill).start()
    begun = time.perf_counter()
    result = work(address)
    return time.perf_counter() - begun, result


def made_alone(chunks):
    subprocess.run([sys.executable, "-c", MAKE, str(chunks)], check=True, env=QUIET)  # noqa: S603


def halves(work, parts):
    """Return the time of two processes that share nothing, each with its half."""
    begun = time.perf_counter()
    both = [threading.Thread(target=work, args=(part,)) for part in parts]
    for one in both:
        one.start()
    for one in both:
        one.join()
    return time.perf_counter() - begun


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=2, help="in turns; the least time counts (2)")
    parser.add_argument("--chunks", type=int, default=4, help="of training data, 256 experiments of each structure")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        files = recordings(Path(folder), args.files)
        kinds = {
            f"diagnose {args.files} files": (
                lambda address: diagnosed(files, address),
                lambda: halves(lambda part: diagnosed(part, None), (files[::2], files[1::2])),
            ),
            f"{args.chunks} chunks to learn from": (
                lambda address: made(args.chunks, address),
                lambda: halves(made_alone, (args.chunks // 2,) * 2),
            ),
        }
        print(f"{'':26} {'workers':20} {'time, s':>8} {'times faster':>13} {'of the limit':>13} {'same':>5}")
        for name, (work, limit) in kinds.items():
            took, limits = {"one": [], "two": [], "two, one killed": []}, []
            for _ in range(args.rounds):
                limits.append(limit())
                for workers, results in took.items():
                    with cluster(1 if workers == "one" else 2) as (address, processes):
                        killed = processes[0] if "killed" in workers else None
                        results.append(timed(work, address, killed, took["two"][-1][0] / 2.0 if killed else 0.0))
            (one_s, truth), *_ = sorted(took["one"])
            for workers, results in took.items():
                least_s = min(seconds for seconds, _ in results)
                same = "yes" if all(result == truth for _, result in results) else "NO"
                share = f"{min(limits) / least_s:13.0%}"
                print(f"{name:26} {workers:20} {least_s:8.1f} {one_s / least_s:13.2f} {share} {same:>5}")
            print(f"{name:26} {'limit: two processes':20} {min(limits):8.1f} {one_s / min(limits):13.2f} {1.0:13.0%}")


if __name__ == "__main__":
    main()
