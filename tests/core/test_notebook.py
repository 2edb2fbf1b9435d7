"""The notebook of the examples runs in a kernel of its own, and shows results as a notebook shows them."""

import subprocess
import sys

import pytest

EXECUTE = """
import sys, nbformat
from nbclient import NotebookClient
notebook = nbformat.read(sys.argv[1], as_version=4)
nbformat.validate(notebook)
NotebookClient(notebook, timeout=None, kernel_name="python3").execute()
for cell in notebook.cells:
    for output in cell.get("outputs", ()):
        data = output.get("data", {})
        print(output.get("text", ""), data.get("text/plain", ""), data.get("text/html", ""), *data)
"""


@pytest.mark.realtime
@pytest.mark.long  # what it calls and shows: test_run_in_program.py
def test_the_notebook_of_the_examples_runs(pytestconfig, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", EXECUTE, str(pytestconfig.rootpath / "examples" / "your_plant.ipynb")],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for shown in ("half period", "<table>", "image/png", "adequate", "calm", "overshoot"):
        assert shown in done.stdout
    assert (tmp_path / "report.html").exists()
