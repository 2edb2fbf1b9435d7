"""`autotuner train`: a run that was cut short goes on, and where the experiments are made does not matter."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from autotuner.cli import main
from autotuner_models.learned.draw import rows_of
from autotuner_models.learned.generation import Plan, generate
from tests.control.processes import PATIENCE_S

PLAN = Plan(seed=7, chunks=1)


def quiet(_done, _total):
    """Nobody is watching."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of the data of `PLAN`, made here in one go."""
    folder = tmp_path_factory.mktemp("whole")
    generate(PLAN, folder, 1, None, quiet)
    return folder


@pytest.fixture(scope="module")
def made(whole):
    """The hash of these data."""
    return generate(PLAN, whole, 1, None, quiet)[1]


def test_an_interrupted_run_goes_on_where_it_was_and_ends_with_the_same_data(made, tmp_path):
    def interrupt(done, _total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(PLAN, tmp_path, 1, None, interrupt)
    begun = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    assert len(begun) == 2
    (tmp_path / "fopdt-7-0099.part").write_bytes(b"half a chunk")
    shown = []
    rows, digest = generate(PLAN, tmp_path, 1, None, lambda done, total: shown.append((done, total)))
    assert digest == made
    assert shown == [(2, 4), (3, 4), (4, 4)]
    assert all(path.stat().st_mtime_ns == when for path, when in begun.items())
    assert all(np.isfinite(part.X).all() for part in rows.values())


def in_a_process(code, *words):
    """Run a script outside: worker processes and clusters end with it."""
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()[-1]


GENERATED = """
import sys
from pathlib import Path
from autotuner_models.learned.generation import Plan, generate
if __name__ == "__main__":
    print(generate(Plan(7, 1), Path(sys.argv[1]), 2, None, lambda done, total: None)[1])
"""
ON_A_CLUSTER = """
import sys
from pathlib import Path
from distributed import LocalCluster
from autotuner_models.learned.generation import Plan, generate
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        print(generate(Plan(7, 1), Path(sys.argv[1]), 2, address, lambda done, total: None)[1])
"""


@pytest.mark.long  # a cluster, below
def test_two_processes_make_the_same_data(made, tmp_path):
    assert in_a_process(GENERATED, str(tmp_path)) == made


def test_a_dask_cluster_makes_the_same_data(made, tmp_path):
    pytest.importorskip("distributed", reason="an extra: only those who have a cluster need it")
    assert in_a_process(ON_A_CLUSTER, str(tmp_path)) == made


def test_whoever_looks_on_does_not_change_a_bit(monkeypatch):
    """A profiler, such as that of Dask's workers, holds frames and what they returned a while longer."""
    alone = rows_of("sopdt_underdamped", 256, (7, 2, 0))
    held, diff = [], np.diff

    def kept(*args, **kwargs):
        held.append(diff(*args, **kwargs))
        return held[-1]

    monkeypatch.setattr(np, "diff", kept)
    watched = rows_of("sopdt_underdamped", 256, (7, 2, 0))
    assert held
    for name in alone._fields:
        np.testing.assert_array_equal(getattr(watched, name), getattr(alone, name), err_msg=name)


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path, capsys):
    taken = tmp_path / "file"
    taken.write_text("in the way")
    assert main(["train", "--output", str(taken / "learned")]) == 1
    assert str(taken / "learned") in capsys.readouterr().err


def test_a_read_only_folder_is_refused_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, _mode: Path(path) != tmp_path)
    assert main(["train", "--output", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "may not be written to" in said
    assert str(tmp_path) in said


@pytest.mark.long
def test_the_whole_command_trains_again_to_the_same_files(tmp_path, capsys):
    manifests = []
    for name in ("one", "two"):
        assert main(["train", "--output", str(tmp_path / name), "--experiments", "4096", "--json"]) == 0
        manifests.append(json.loads(capsys.readouterr().out))
    assert manifests[0]["data_sha256"] == manifests[1]["data_sha256"]
    assert manifests[0]["sha256"]["learned.arrays"] == manifests[1]["sha256"]["learned.arrays"]
    assert (tmp_path / "one" / "model-card.md").is_file()
