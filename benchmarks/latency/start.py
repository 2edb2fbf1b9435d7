"""What a start costs, in processor time and memory, beside importing what the service stands on.

    python benchmarks/latency/start.py [--rounds N]

eager       numpy, scipy, scikit-learn, pymodbus, pyserial, fastapi, uvicorn and joblib imported
python      an interpreter that does nothing: the limit
--help      `autotuner --help`
listening   `autotuner serve` until it answers; a second without requests later the memory is taken again
kept        the same after `/readyz`, which opens the database
tuning      the same once the first samples of a tuning are in the database: before anything is identified

Processes of their own, in turns; the least of all rounds counts. Modules are compiled before, as by an installation.
"""

import argparse
import contextlib
import http.client
import json
import math
import os
import resource
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path

EAGER = "import numpy, scipy, sklearn, pymodbus, serial, fastapi, uvicorn, joblib"
MIB = 1024.0


def spent_s(*words, env):
    """Return the processor time of a process, s, and no memory: what it shares with this one counts there too."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *words], env=env, stdout=subprocess.DEVNULL, check=True)  # noqa: S603 - ourselves
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, math.nan


def so_far(pid):
    """Return processor time, s, and memory, MiB, of a running process."""
    ns = sum(int(file.read_text().split()[0]) for file in Path(f"/proc/{pid}/task").glob("*/schedstat"))
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return 1e-9 * ns, pages * os.sysconf("SC_PAGE_SIZE") / MIB**2


def answered(port, path, method="GET"):
    """Return whether the service answers with success."""
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)
    try:
        line.request(method, path)
        return line.getresponse().status in {200, 202}
    except OSError:
        return False
    finally:
        line.close()


def samples_kept(folder):
    """Return whether samples are in the database of a service that runs in a folder."""
    with contextlib.closing(sqlite3.connect(Path(folder) / "relay-autotuner" / "tunings.sqlite")) as database:
        return database.execute("SELECT count(*) FROM recording_chunks").fetchone()[0] > 0


def served(env):
    """Return processor time and memory at the stages of a start."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "autotuner", "serve", "--json", "--port", str(port)]
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen(command, env=env | {"XDG_STATE_HOME": folder}, cwd=folder, text=True, **streams)  # noqa: S603 - ourselves
        try:
            json.loads(process.stdout.readline())
            listening = so_far(process.pid)
            time.sleep(1.0)
            listening = (listening[0], so_far(process.pid)[1])
            assert answered(port, "/readyz")
            kept = so_far(process.pid)
            assert answered(port, "/v1/loops/demo/tunings", "POST")
            while not samples_kept(folder):
                time.sleep(0.05)
            return {"listening": listening, "kept": kept, "tuning": so_far(process.pid)}
        finally:
            process.terminate()
            process.communicate()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    args = parser.parse_args()
    best = {}
    with tempfile.TemporaryDirectory() as compiled:
        env = {**os.environ, "PYTHONPYCACHEPREFIX": compiled}
        env.pop("PYTHONDONTWRITEBYTECODE", None)
        for count in range(args.rounds + 1):  # the first round compiles
            found = {
                "eager": spent_s("-c", EAGER, env=env),
                "python": spent_s("-c", "", env=env),
                "--help": spent_s("-m", "autotuner", "--help", env=env),
                **served(env),
            }
            if count:
                best = {name: tuple(map(min, row, best.get(name, row))) for name, row in found.items()}
    print(f"{'':10} {'processor, s':>13} {'of eager':>9} {'eager/this':>11} {'memory, MiB':>12}")
    for name, (seconds, memory) in best.items():
        share = seconds / best["eager"][0]
        print(f"{name:10} {seconds:13.3f} {share:9.3f} {1.0 / share:11.2f} {memory:12.1f}")


if __name__ == "__main__":
    main()
