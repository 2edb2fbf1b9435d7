"""How late the deadlines of a control loop are met: by the usual timers, by ours, and by a bare thread as the limit.

    python benchmarks/latency/lateness.py [--rates HZ ...] [--seconds S] [--rounds N]

Each way keeps absolute deadlines for a while, all in turns within one run, so that what else the machine does meets all
of them alike: `loop.call_at` and our ticker on Python's usual event loop, the ticker there with timers of the kernel as
in a loop process (`autotuner.control.clock.real_time`), and `time.sleep` in a thread that does nothing else.
Printed is the lateness of the deadlines met, and how many were missed by a whole period.
"""

import argparse
import asyncio
import time

import numpy as np

from autotuner.control.clock.real_time import fine_timers
from autotuner.control.clock.ticker import Stop, Ticker, next_index


async def called_at(period_s, seconds):
    loop, lateness = asyncio.get_running_loop(), []
    done, first = loop.create_future(), loop.time()

    def due(index):
        now = loop.time()
        lateness.append(now - first - index * period_s)
        if now - first >= seconds:
            done.set_result(None)
        else:
            following = next_index(now - first, period_s)
            loop.call_at(first + following * period_s, due, following)

    loop.call_at(first + period_s, due, 1)
    await done
    return lateness


async def ticked(period_s, seconds):
    ticker, stop, lateness = Ticker(period_s), Stop(), []
    await ticker.tick(stop)
    while (tick := await ticker.tick(stop)) is not None:
        lateness.append(tick.lateness_s)
        if tick.t >= seconds:
            break
    return lateness


async def finely_ticked(period_s, seconds):
    with fine_timers():
        return await ticked(period_s, seconds)


def slept(period_s, seconds):
    first, index, lateness = time.monotonic(), 0, []
    while index * period_s < seconds:
        index = max(next_index(time.monotonic() - first, period_s), index + 1)
        time.sleep(max(first + index * period_s - time.monotonic(), 0.0))
        lateness.append(time.monotonic() - first - index * period_s)
    return lateness


WAYS = {
    "call_at": lambda *args: asyncio.run(called_at(*args)),
    "ticker": lambda *args: asyncio.run(ticked(*args)),
    "ticker, fine timers": lambda *args: asyncio.run(finely_ticked(*args)),
    "bare thread": slept,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=float, nargs="+", default=[100.0, 1000.0], help="deadlines a second")
    parser.add_argument("--seconds", type=float, default=1.0, help="of one way at a time (1)")
    parser.add_argument("--rounds", type=int, default=8)
    args = parser.parse_args()
    print(f"{'':22} {'Hz':>6} {'met':>7} {'p50':>9} {'p90':>9} {'p99':>9} {'max, us':>9} {'missed':>8}")
    for rate in args.rates:
        met = {name: [] for name in WAYS}
        for _ in range(args.rounds):
            for name, way in WAYS.items():
                met[name] += way(1.0 / rate, args.seconds)
        for name, lateness in met.items():
            late = 1e6 * np.maximum(lateness, 0.0)
            told = " ".join(f"{v:9.0f}" for v in [*np.percentile(late, (50.0, 90.0, 99.0)), late.max()])
            missed = 1.0 - len(late) / (rate * args.seconds * args.rounds)
            print(f"{name:22} {rate:6.0f} {len(late):7d} {told} {max(missed, 0.0):8.2%}")


if __name__ == "__main__":
    main()
