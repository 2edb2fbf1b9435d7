"""Identification of closed loops that an unmeasured load moves about as much as the set point does.

    python -m benchmarks.accuracy.estimates.loops_with_load [--sizes PV ...] [--seeds N] [--first N]

Three processes, each in a PI loop whose set point moves by 2 PV in five steps. The load is correlated over 20 s, with
a standard deviation of 0.3 to 2 PV at rest; nobody records it. The structure is not given. Each record is identified by
plain least squares and by what the program answers; "for gains" counts those for which gains would be computed.
"""

import argparse

import numpy as np
from rich.console import Console
from rich.table import Table

from autotuner.core.estimation.data import GainPrior, data_of
from autotuner.core.identification import identify
from autotuner.core.identification.advice import unexplained_share
from autotuner.core.identification.result import most_unexplained
from autotuner.core.identification.selection import choose
from autotuner.core.signals.feedback import process_sign
from benchmarks.accuracy.cases.loop_with_load import loop_with_load

SHOW = Console(width=150)
PROCESSES = ((1.5, 15.0, 5.0), (-2.0, 30.0, 8.0), (0.8, 10.0, 10.0))
"""Gain, lag and dead time, s."""


def by_least_squares(record):
    """Return gain, interval and whether gains would be computed; None for no answer."""
    choice = choose(data_of(record), "auto", GainPrior(None, process_sign(record)))
    if choice is None or not choice.best.is_shown():
        return None
    ends = choice.best.uncertainty(profile=False).interval95["K"]
    return choice.best.model.K, ends, unexplained_share(choice.best, record, 0.0) <= most_unexplained(choice.best.model)


def by_the_program(record):
    """Return the same of the program's answer."""
    answer = identify(record, profile=False)
    if answer.model is None:
        return None
    return answer.model.K, answer.estimates["least_squares"].interval95["K"], not answer.is_a_guess


WAYS = {"plain least squares": by_least_squares, "the program": by_the_program}


def row(way, size, seeds):
    """Return the cells of one way at one size of the load."""
    answers = [
        (gain, WAYS[way](loop_with_load(seed, gain=gain, lag_s=lag, dead_time_s=dead_time, size=size)[0]))
        for gain, lag, dead_time in PROCESSES
        for seed in seeds
    ]
    given = [(gain, *answer) for gain, answer in answers if answer is not None]
    off = [abs(found / gain - 1.0) for gain, found, _, _ in given]
    return (
        f"{len(given)} of {len(answers)}",
        str(sum(found * gain < 0.0 for gain, found, _, _ in given)),
        f"{np.median(off):.1%}",
        f"{np.mean([low <= gain <= high for gain, _, (low, high), _ in given]):.0%}",
        str(sum(usable for *_, usable in given)),
        str(sum(usable and found * gain < 0.0 for gain, found, _, usable in given)),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=float, nargs="+", default=(0.3, 1.0, 2.0), help="of the load, PV")
    parser.add_argument("--seeds", type=int, default=20, help="records of each process (20)")
    parser.add_argument("--first", type=int, default=101, help="first seed (101)")
    args = parser.parse_args()
    table = Table(title=f"{args.seeds} records of each of {len(PROCESSES)} processes, seeds from {args.first}")
    titles = (
        "load, PV",
        "way",
        "answered",
        "wrong sign",
        "gain off, median",
        "interval holds",
        "for gains",
        "of wrong sign",
    )
    for title in titles:
        table.add_column(title)
    for size in args.sizes:
        for way in WAYS:
            table.add_row(f"{size:g}", way, *row(way, size, range(args.first, args.first + args.seeds)))
    SHOW.print(table)


if __name__ == "__main__":
    main()
