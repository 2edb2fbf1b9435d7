"""What nobody should upload: is it refused, how soon, and how much memory does it take meanwhile?

    python benchmarks/safety/requests/hostile_uploads.py [--only WORD]

A service in a process of its own, and each body sent to it piece by piece as fast as it takes it; beside it one loop is
tuned at 10 Hz. Told are the answer, the time until it came, the largest memory of the service and of its workers
together since the start, and the worst lateness of a sample so far.
"""

import argparse
import gzip
import io
import time
import zipfile
from pathlib import Path

import httpx

from benchmarks.scale._service import service

MIB = 2**20
CSV = {"Content-Type": "text/csv"}


def endless(size, line=b"0.1,40.0,80.0\n"):
    """Yield so many bytes of a recording, and its header first."""
    yield b"t,u,y\n"
    piece = line * (MIB // len(line))
    for _ in range(size // len(piece)):
        yield piece


def length(pieces):
    return sum(map(len, pieces))


def rows(count):
    """Yield a recording of so many rows that makes sense."""
    yield b"t,u,y\n"
    for first in range(0, count, 10_000):
        yield b"".join(
            b"%.1f,%d,%.2f\n" % (0.1 * k, 40 + 10 * (k // 50 % 2), 80 + k % 97 / 10)
            for k in range(first, first + 10_000)
        )


def zipped():
    """Return a zip archive of a kilobyte for each megabyte that it would become."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.csv", "w") as inside:
        for piece in endless(1024 * MIB):
            inside.write(piece)
    return file.getvalue()


def gzipped():
    return gzip.compress(b"".join(endless(256 * MIB)))


def text(content, encoding="utf-8"):
    return "\n".join(["t,u,y", *content]).encode(encoding)


STEP = [f"{k / 10},{40 + 10 * (k > 20)},{80 + max(0, k - 25) * 0.1}" for k in range(60)]
BODIES = {
    "1 GB of rows": lambda: (endless(1000 * MIB), CSV),
    "1 GB, declared": lambda: (endless(1000 * MIB), CSV | {"Content-Length": str(length(endless(1000 * MIB)))}),
    "10 million rows": lambda: (rows(10_000_000), CSV),
    "600,000 rows": lambda: (rows(600_000), CSV),
    "one line of 30 MB": lambda: (b"t,u,y\n" + b"1" * 30 * MIB, CSV),
    "a million columns": lambda: (b",".join([b"a"] * 1_000_000) + b"\n", CSV),
    "zip of 1 GB": lambda: (zipped(), CSV),
    "gzip of 256 MB": lambda: (gzipped(), CSV),
    "gzip, declared": lambda: (gzipped(), CSV | {"Content-Encoding": "gzip"}),
    "NaN": lambda: (text(["0,nan,nan"] * 60), CSV),
    "1e308": lambda: (text([f"{k},1e308,-1e308" for k in range(60)]), CSV),
    "UTF-16": lambda: (text(STEP, "utf-16"), CSV),
    "UTF-16 without mark": lambda: (text(STEP, "utf-16-le"), CSV),
    "UTF-32": lambda: (text(STEP, "utf-32"), CSV),
    "EBCDIC": lambda: (text(STEP, "cp037"), CSV),
    "bytes of chance": lambda: (bytes(range(256)) * 4000, CSV),
    "nothing": lambda: (b"", CSV),
    "JSON": lambda: (b'{"a": ' * 100_000, {"Content-Type": "application/json"}),
}


def memory_mib(process):
    """Return the largest memory of a process and its children since they began, MiB."""
    task = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    found = [process.pid, *map(int, task.read_text().split())]
    lines = [row for pid in found for row in Path(f"/proc/{pid}/status").read_text().splitlines()]
    return sum(int(row.split()[1]) for row in lines if row.startswith("VmHWM")) / 1024.0


def send(client, path, body, headers):
    begun = time.perf_counter()
    try:
        answer = client.post(path, content=body, headers=headers)
        told = f"{answer.status_code} {answer.json().get('type', '').rpartition('#')[2] or 'done'}"
    except httpx.TransportError as error:  # the service has answered and closed the line before all was sent
        told = type(error).__name__
    return told, time.perf_counter() - begun


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="bodies whose name has this word")
    args = parser.parse_args()
    with service(1, 10.0, requests_per_s=1000.0, politeness=5) as (client, process):
        tuning = client.post("/v1/loops/loop-0/tunings").headers["location"]
        send(client, "/v1/identifications", text(STEP), CSV)  # the workers are there
        print(f"at rest: {memory_mib(process):.0f} MiB")
        print(f"{'body':20} {'identify':32} {'s':>6}  {'diagnose':32} {'s':>6} {'MiB':>6} {'late, ms':>9}", flush=True)
        for name, make in BODIES.items():
            if args.only not in name:
                continue
            told = [send(client, path, *make()) for path in ("/v1/identifications", "/v1/diagnoses")]
            shown = "  ".join(f"{what:32} {took:6.2f}" for what, took in told)
            late = 1e3 * client.get(tuning).json()["lateness"]["max_s"]
            print(f"{name:20} {shown} {memory_mib(process):6.0f} {late:9.1f}", flush=True)
        ended = client.get(tuning).json()["state"]
        print(f"the tuning beside it: {ended}; /healthz: {client.get('/healthz').status_code}")
        client.post(f"{tuning}/abort")


if __name__ == "__main__":
    main()
