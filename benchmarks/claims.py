"""Claims of the documentation beside what the program says now.

    python -m benchmarks.claims [--only TEXT]

Each claim is a sentence or a row of a page with a number in it, the command that measures it, and where the number is
in that command's output. Printed: page, claim, command, the printed and the present number, and whether they agree. The
exit code is 1 where one does not. Each command runs once, in a folder of its own; all of them take about ten minutes.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
REPRODUCE = "autotuner reproduce thesis"
OUTSIDE = "python -m benchmarks.accuracy.diagnosis.effects --seeds 4 --first 900 --sections outside"
HIGHER = "python -m benchmarks.accuracy.estimates.higher_order --plants 20 --seed 101"
NUMBER = r"([-\d.]+)"


@dataclass(frozen=True)
class Claim:
    """A number of a page: what it is, patterns with one group in page and output, command, allowed difference."""

    page: str
    says: str
    printed: str
    command: str
    present: str
    within: float = 0.0


def _mark(name: str, column: int) -> Claim:
    cells = r"\D+".join([r"│ all", *([r"\d+"] * column), NUMBER])
    return Claim("docs/learned.md", f"figures {name}", rf"\| {name} \| {NUMBER} \|", REPRODUCE, cells)


COLUMNS = {"tree": (1, 2), "forest": (2, 3), "linear": (3, 4), "network": (4, 5)}
"""Columns of the scores on the thesis's grid: how many cells stand before them in the page, and in the output."""


def _scores(page: str, data: str, target: str) -> list[Claim]:
    """Return the claims of one row of the scores on the thesis's own grid, and off it."""

    def claim(name: str, before: int, present: str) -> Claim:
        printed = rf"{page}(?:[^|]*\|){{{before}}}\W*{NUMBER}"
        return Claim("docs/learned.md", f"R2 of {name}, {data} {target}", printed, REPRODUCE, present, 2e-4)

    row = rf"│ {data}\W+{target}\W+│"
    on_grid = [
        claim(name, before, rf"{row}(?:[^│]*│){{{after}}}\W*{NUMBER}") for name, (before, after) in COLUMNS.items()
    ]
    return [*on_grid, claim("the thesis's family off the grid", 5, rf"{row} off grid(?:[^│]*│){{2}}\W*{NUMBER}")]


def _right(kind: str) -> Claim:
    cells = rf" \| \d+ \| {NUMBER}"
    name = kind.replace("n_lags", "equal lags")
    says = f"right structure of evident {name}, %"
    return Claim("docs/identification.md", says, rf"\| {name}{cells}", HIGHER, rf"\| {kind} \| \d+{cells}", 5.0)


GRID = (
    (r"\| FOPDT, 585 rows \| T \|", "fopdt", "T"),
    (r"FOPDT, 585 rows[^\n]*\n\| \| D \|", "fopdt", "D"),
    (r"\| FOPDT, 20 dB \| T \|", "fopdt_noise", "T"),
    (r"FOPDT, 20 dB \| T[^\n]*\n\| \| D \|", "fopdt_noise", "D"),
    (r"\| overdamped, 1,435 \| T1 \|", "overdamped", "T1"),
    (r"overdamped, 1,435[^\n]*\n\| \| T2 \|", "overdamped", "T2"),
    (r"\| underdamped, 732 \| m \|", "underdamped", "m"),
    (r"underdamped, 732[^\n]*\n\| \| n \|", "underdamped", "n"),
)
"""Rows of the table of scores: how each begins in the page, its data set and its target."""
CLAIMS = (
    _mark("remade", 0),
    _mark("arithmetic", 1),
    _mark("misprint", 2),
    _mark("not reproducible", 3),
    _mark("not stated", 4),
    *(claim for row in GRID for claim in _scores(*row)),
    _right("n_lags"),
    Claim(
        "docs/effects.md",
        "outside of the catalogue, %",
        rf"outside of the catalogue[^|]*\| \d+ \| {NUMBER}",
        OUTSIDE,
        rf"unexplained or nearest {NUMBER}",
        5.0,
    ),
)


@cache
def _output(command: str) -> str:
    """Return what a command prints, with the interpreter that runs this one; wide enough that no row is folded."""
    beside = Path(sys.executable).parent
    words = shlex.split(command)
    words[0] = sys.executable if words[0] == "python" else str(beside / words[0])
    environment = {**os.environ, "COLUMNS": "400", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)  # noqa: S603
    return done.stdout


def _found(pattern: str, text: str) -> float | None:
    match = re.search(pattern, text)
    return float(match.group(1).rstrip(".")) if match else None


def main() -> int:
    """Print the table; return 1 where a claim does not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="TEXT", help="claims with this in page, claim or command")
    args = parser.parse_args()
    wrong = 0
    print("| page | claim | command | printed | present | holds |\n|---|---|---|---|---|---|")
    for claim in CLAIMS:
        if args.only not in f"{claim.page} {claim.says} {claim.command}":
            continue
        printed = _found(claim.printed, (ROOT / claim.page).read_text())
        present = _found(claim.present, _output(claim.command))
        holds = printed is not None and present is not None and abs(printed - present) <= claim.within + 1e-12
        wrong += not holds
        told = (
            f"| {claim.page} | {claim.says} | `{claim.command}` | {printed} | {present} | {'yes' if holds else 'NO'} |"
        )
        print(told, flush=True)
    return int(wrong > 0)


if __name__ == "__main__":
    raise SystemExit(main())
