"""One row, one answer: plain arrays and plain trees against scikit-learn's calls, warm and from a cold process.

    python benchmarks/latency/learned_speed.py [--learned DIR]

warm   the thesis's tree and forest (T of FOPDT) and the shipped correction, one row at a time, interleaved: least time
       of each over `ROUNDS` rounds, and the largest difference of their answers
cold   from a started interpreter to the first answer, processor time of a process of its own less that of one that does
       nothing: scikit-learn's objects from joblib files against the plain forms
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import timeit
from pathlib import Path

import joblib
import numpy as np
from rich.console import Console
from rich.table import Table

from autotuner_models.learned.artefacts import ARRAYS, OBJECTS, SHIPPED, load, load_objects
from autotuner_models.learned.draw import rows_of
from autotuner_models.thesis.data_sets import OFF_GRID
from autotuner_models.thesis.plain_trees import answer, as_plain, save_plain
from autotuner_models.thesis.regressors import other_rows, trained

ROUNDS, CALLS = 15, 40
COLD_ROUNDS = 5
SHOW = Console(width=120)


def least_us(statements, names):
    """Return the least time of each statement, us, the statements taking turns; `names` is what they speak of."""
    best = dict.fromkeys(statements, float("inf"))
    for _ in range(ROUNDS):
        for one in statements:
            best[one] = min(best[one], timeit.timeit(one, globals=names, number=CALLS) / CALLS)
    return [1e6 * best[one] for one in statements]


def warm(args):
    models, objects = load(args.learned), load_objects(args.learned)
    rows, X = rows_of("fopdt", 64, (5, 0, 0)), other_rows("fopdt", OFF_GRID).X[:200]
    correction, pipelines = models.corrections["fopdt"], objects["fopdt"]
    forms = {}
    for family in ("tree", "forest"):
        regressor = trained("fopdt", 0, family).regressor
        plain = as_plain(regressor)
        gap = max(
            abs(answer(plain, one) - theirs) for one, theirs in zip(X.tolist(), regressor.predict(X), strict=True)
        )
        forms[f"thesis's {family}"] = (
            ("regressor.predict(row)", "answer(plain, listed)"),
            {"regressor": regressor, "row": X[:1], "answer": answer, "plain": plain, "listed": X[0].tolist()},
            gap,
        )
    gap = np.abs(np.stack([one.predict(rows.X) for one in pipelines]) - correction.networks(rows.X)).max()
    forms["shipped networks"] = (
        ("[one.predict(row) for one in pipelines]", "apply(row, start)"),
        {"pipelines": pipelines, "row": rows.X[:1], "start": rows.start[:1], "apply": correction.apply},
        gap,
    )
    shown = Table("one row", "scikit-learn, us", "plain, us", "ratio", "largest difference")
    for name, (statements, names, gap) in forms.items():
        theirs, ours = least_us(statements, names)
        shown.add_row(name, f"{theirs:.1f}", f"{ours:.2f}", f"{theirs / ours:.0f}", f"{gap:.1e}")
    SHOW.print(shown)


OBJECTS_COLD = """
import io, json, sys
import joblib, sklearn, numpy
regressor = joblib.load(sys.argv[1])
row = numpy.array([json.loads(sys.argv[2])])
print([float(one.predict(row).ravel()[0]) for one in (regressor if isinstance(regressor, tuple) else (regressor,))])
"""
PLAIN_COLD = """
import json, sys
from autotuner_models.thesis.plain_trees import answer, load_plain
print(answer(load_plain(sys.argv[1]), json.loads(sys.argv[2])))
"""
ARRAYS_COLD = """
import json, sys
from autotuner_models.learned.plain import answers, load_networks
print(answers(load_networks(sys.argv[1], "fopdt"), json.loads(sys.argv[2])))
"""


def spent_s(code, *words):
    """Return the least processor time of a process, s."""
    least = float("inf")
    for _ in range(COLD_ROUNDS):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-c", code, *words], check=True, stdout=subprocess.DEVNULL)  # noqa: S603 - ourselves
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        least = min(least, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return least


def cold(args):
    nothing = spent_s("")
    row = json.dumps(other_rows("fopdt", OFF_GRID).X[0].tolist())
    shown = Table("from a cold process", "scikit-learn, ms", "plain, ms", "ratio")

    def add(name, theirs, ours):
        cells = (1e3 * (theirs - nothing), 1e3 * (ours - nothing))
        shown.add_row(name, *(f"{cell:.1f}" for cell in cells), f"{cells[0] / cells[1]:.0f}")

    with tempfile.TemporaryDirectory() as kept:
        for family in ("tree", "forest"):
            joblib_file, plain_file = Path(kept, f"{family}.joblib"), Path(kept, f"{family}.json")
            regressor = trained("fopdt", 0, family).regressor
            joblib.dump(regressor, joblib_file)
            save_plain(plain_file, as_plain(regressor))
            theirs, ours = (spent_s(OBJECTS_COLD, str(joblib_file), row), spent_s(PLAIN_COLD, str(plain_file), row))
            add(f"thesis's {family}", theirs, ours)
        one = Path(kept, "networks.joblib")
        joblib.dump(load_objects(args.learned)["fopdt"], one)
        row = json.dumps(rows_of("fopdt", 4, (5, 0, 0)).X[0].tolist())
        theirs, ours = spent_s(OBJECTS_COLD, str(one), row), spent_s(ARRAYS_COLD, str(args.learned), row)
        add("shipped networks", theirs, ours)
    SHOW.print(shown)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--learned", type=Path, default=SHIPPED, metavar="DIR", help=f"folder with {ARRAYS}, {OBJECTS}")
    args = parser.parse_args()
    warm(args)
    cold(args)


if __name__ == "__main__":
    main()
