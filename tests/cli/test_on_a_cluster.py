"""`autotuner diagnose --dask`: the same results from a cluster's workers."""

import json
import subprocess
import sys

import numpy as np
import pytest

from tests.control.processes import PATIENCE_S

pytest.importorskip("distributed", reason="an extra: only those who have a cluster need it")

ON_A_CLUSTER = """
import sys
from distributed import LocalCluster
from autotuner.cli import main
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        sys.exit(main(["diagnose", *sys.argv[1:], "--json", "--dask", cluster.scheduler_address]))
"""
HERE = """
import sys
from autotuner.cli import main
sys.exit(main(["diagnose", *sys.argv[1:], "--json"]))
"""
WITHOUT_ONE = """
import sys
from autotuner.cli import main
from autotuner.application.computing import cluster
cluster.CONNECT_S = 0.2
sys.exit(main(["diagnose", sys.argv[1], "--dask", "tcp://127.0.0.1:9"]))
"""


@pytest.fixture
def files(tmp_path):
    """A step test of T dy/dt + y = 2 u with a little noise, and a file that is no recording."""
    t, rng = np.arange(0.0, 60.0, 0.5), np.random.default_rng(1)
    y = 20.0 * (1.0 - np.exp(-np.maximum(t - 10.0, 0.0) / 5.0)) + 0.05 * rng.standard_normal(t.size)
    rows = [f"{a},{10.0 * (a >= 10.0)},{b}" for a, b in zip(t, y, strict=True)]
    (tmp_path / "step.csv").write_text("\n".join(["t,u,y", *rows]))
    (tmp_path / "none.csv").write_text("t,u,y\n")
    return [
        str(tmp_path / name) for name in ("none.csv", "step.csv", "absent.csv")
    ]  # not by size, as a cluster begins them


def outside(code, *words):
    """Run a script in a process of its own: clusters and their threads end with it."""
    return subprocess.run(
        [sys.executable, "-c", code, *words],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


@pytest.mark.realtime
def test_a_cluster_finds_the_same(files):
    here, there = outside(HERE, *files), outside(ON_A_CLUSTER, *files)
    assert (there.returncode, there.stdout) == (here.returncode, here.stdout), there.stderr
    assert ["verdict" in json.loads(line) for line in here.stdout.splitlines()] == [False, True, False]


@pytest.mark.realtime
def test_a_scheduler_that_does_not_answer_is_told(files):
    done = outside(WITHOUT_ONE, files[1])
    assert done.returncode == 2
    assert "--dask" in done.stderr
