"""How late the samples of a running tuning come while the service is kept busy by others.

    python benchmarks/service_load.py [--readers N] [--rows N]

One slow simulated loop is sampled at 10 Hz by a service in a process of its own, first alone, then with N readers of
its live events and a recording of `--rows` rows uploaded for identification. Prints the lateness of the samples so far
after each part, and how long the upload took.
"""

import argparse
import contextlib
import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import httpx

LOOPS = """
[loops.busy]
driver = "simulated"
sample_time_s = 0.1
relay = { amplitude = 10.0 }
device = { plant = { structure = "fopdt", K = 2.0, T = 600.0, D = 90.0 }, output0 = 40.0, pv0 = 80.0, noise = 0.05 }
"""
ALONE_S = 15.0


@contextlib.contextmanager
def service():
    """Yield a client of a service that runs in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "loops.toml"
        file.write_text(LOOPS, encoding="utf-8")
        command = [sys.executable, "-m", "autotuner.cli", "serve", "--port", "0", "--config", str(file)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)  # noqa: S603
        try:
            url = json.loads(process.stdout.readline())["listening"]
            with httpx.Client(base_url=url, timeout=600.0) as client:
                yield client
        finally:
            process.terminate()
            process.communicate()


def recording(rows):
    """Return the CSV of an output that moves in steps and a PV that does not answer to it."""
    lines = (f"{0.1 * i:.1f},{40 + 10 * (i // 50 % 2)},{80 + i % 97 * 0.1:.1f}" for i in range(rows))
    return "\n".join(["t,u,y", *lines]).encode()


def read(client, path, count):
    with contextlib.suppress(httpx.HTTPError), client.stream("GET", f"{path}/events") as stream:
        count.append(sum(line.startswith("data:") for line in stream.iter_lines()))


def report(client, path, what):
    told = client.get(path).json()
    lateness = "  ".join(f"{name[:-2]} {1e3 * value:6.2f} ms" for name, value in told["lateness"].items())
    print(f"{what:24} {told['samples']:6} samples  {lateness}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--readers", type=int, default=20)
    parser.add_argument("--rows", type=int, default=1_500_000)
    args = parser.parse_args()
    with service() as client:
        path = client.post("/v1/loops/busy/tunings").headers["location"]
        time.sleep(ALONE_S)
        report(client, path, "alone")
        counts = []
        readers = [threading.Thread(target=read, args=(client, path, counts)) for _ in range(args.readers)]
        for reader in readers:
            reader.start()
        body = recording(args.rows)
        begun = time.perf_counter()
        answer = client.post("/v1/identifications", content=body, headers={"Content-Type": "text/csv"})
        took_s = time.perf_counter() - begun
        print(f"upload of {len(body) / 2**20:.1f} MiB: status {answer.status_code} after {took_s:.1f} s")
        report(client, path, f"{args.readers} readers and an upload")
        client.post(f"{path}/abort")
        for reader in readers:
            reader.join()
        print(f"events read: {min(counts)} to {max(counts)} by each of {len(counts)} readers")


if __name__ == "__main__":
    main()
