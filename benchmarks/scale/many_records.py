"""Recordings diagnosed in parallel: how the time for two hundred of them falls with the processes.

    autotuner bench many_records [--records 200] [--jobs 2] [--chunk 20] [--first 600]

Each record is a tuning's experiment on a plant of its own, with an effect hidden in it or with none (see `effects`), as
a CSV file's bytes: what `autotuner diagnose *.csv --jobs N` hands to its processes, and by the same function. Chunks of
them are timed by turns with one process and with N, so that whatever else the machine does falls on both alike; the
processes are started before. Answers of both ways have to be the same.
"""

import argparse
import json
import os
import statistics
import time
from pathlib import Path

import joblib

from autotuner.commands.diagnose import diagnose_file
from autotuner.errors import AutotunerError
from benchmarks.accuracy.cases._hidden import FORMS
from benchmarks.accuracy.cases._scenes import KINDS, RefusedError
from benchmarks.accuracy.diagnosis.effects import Case, record

DECIBEL = 40.0


def cases(count, first):
    """Return more cases than are asked for, because some experiments refuse: every fourth has nothing hidden."""
    forms = [form for form in FORMS if form.textbook]
    for number in range(2 * count):
        form, kind = forms[number % len(forms)], KINDS[number % len(KINDS)]
        if number % 4 == 3:
            yield Case("clean", (), kind, 0, DECIBEL, first + number)
        elif kind in form.kinds:
            yield Case("single", ((form.effect, form.label),), kind, number % 2, DECIBEL, first + number)


def content(case):
    """Return a record as a file's bytes; None where the experiment refused."""
    try:
        return record(case)[0].to_csv().encode()
    except RefusedError:
        return None


def told(file, text):
    """Return the diagnosis of a file as `autotuner diagnose --json` prints it."""
    answer = diagnose_file(Path(file), text, None, None, None)
    return json.dumps(answer.to_dict(), sort_keys=True) if not isinstance(answer, AutotunerError) else str(answer)


def timed(parallel, chunk):
    began_s = time.perf_counter()
    answers = parallel(joblib.delayed(told)(name, text) for name, text in chunk)
    return time.perf_counter() - began_s, answers


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--records", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--chunk", type=int, default=20)
    parser.add_argument("--first", type=int, default=600, help="first seed")
    options = parser.parse_args(arguments)
    with joblib.Parallel(options.jobs) as many, joblib.Parallel(1) as one:
        made = many(joblib.delayed(content)(case) for case in cases(options.records, options.first))
        texts = [text for text in made if text is not None][: options.records]
        files = [(f"record_{number}.csv", text) for number, text in enumerate(texts)]
        for parallel in (one, many):
            timed(parallel, files[: 2 * options.jobs])  # whatever is loaded or compiled once
        ratios, sums, same = [], [0.0, 0.0], True
        for at in range(0, len(files), options.chunk):
            chunk = files[at : at + options.chunk]
            (alone_s, first), (together_s, second) = timed(one, chunk), timed(many, chunk)
            ratios.append(alone_s / together_s)
            sums = [sums[0] + alone_s, sums[1] + together_s]
            same = same and first == second
            print(f"{at + len(chunk):4d} records  {alone_s:7.2f} s  {together_s:7.2f} s  {ratios[-1]:5.2f}", flush=True)
    print(
        f"{len(files)} records, {os.cpu_count()} cores: {sums[0]:.1f} s with one process, {sums[1]:.1f} s with "
        f"{options.jobs}: {sums[0] / sums[1]:.2f} times as fast (chunks: median {statistics.median(ratios):.2f}, "
        f"{min(ratios):.2f} to {max(ratios):.2f}); answers {'the same' if same else 'NOT the same'}"
    )
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main())
