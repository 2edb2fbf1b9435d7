"""A service in a process of its own that tunes simulated loops by a relay that goes on and on."""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import httpx

LOOP = """
[loops.loop-{number}]
driver = "simulated"
sample_time_s = {period_s:g}
relay = {{ amplitude = 10.0, min_periods = 500, max_periods = 1000 }}
device = {{ plant = {{ structure = "fopdt", K = 2.0, T = 200.0, D = 30.0 }}, output0 = 40.0, pv0 = 80.0, noise = 0.05 }}
"""


@contextlib.contextmanager
def service(loops, rate, *, requests_per_s, politeness):
    """Yield a client of the service, and its process; this process gives way to it by `politeness` steps of nice."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "loops.toml"
        limits = f"requests_per_s = {requests_per_s}\nconnections_limit = 1000\n"
        tables = "".join(LOOP.format(number=n, period_s=1.0 / rate) for n in range(loops))
        file.write_text(f'[service]\ndata_directory = "{folder}/data"\n{limits}{tables}')
        command = [sys.executable, "-m", "autotuner.cli", "serve", "--json", "--port", "0", "--config", str(file)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)  # noqa: S603
        try:
            url = json.loads(process.stdout.readline())["listening"]
            with contextlib.suppress(OSError):  # clients are other machines: they shall not take the service's turns
                os.nice(politeness)
            with httpx.Client(base_url=url, timeout=600.0, limits=httpx.Limits(max_connections=None)) as client:
                yield client, process
        finally:
            process.terminate()
            process.communicate()


def processor_s(process):
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
