"""Wrong command lines, generated from the options of every command: what each is answered, and how fast.

    python benchmarks/safety/requests/wrong_options.py [--count N] [--seed N]

Each is run as a process of its own, with a loop whose functions would write a file: a device that was touched. Printed
are how many lines name field, value and remedy, how many touched the device, and the times from start to exit, which
other programs make longer, and of the processor.
"""

import argparse
import os
import random
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from autotuner.commands.command_line import command_line
from autotuner.commands.terminal.usage import Number, OneOf, WholeNumber

RIG = """
from pathlib import Path
def read(): return _touched()
def write(output): return _touched()
def _touched():
    Path({mark!r}).write_text("touched")
    return 0.0
"""
LOOP = """
[loops.rig]
driver = "python"
sample_time_s = 0.1
limits = {{ output = [0.0, 100.0], pv = [0.0, 100.0] }}
[loops.rig.device]
path = {folder!r}
read = "touched_rig:read"
write = "touched_rig:write"
read_output = "touched_rig:read"
"""
NO_NUMBERS = ("x", "1,5", "nan", "inf", "1e400", "ten", "0x1", "")
NO_WHOLE_NUMBERS = ("x", "1.5", "nan", "-7", "")
NO_NAMES = ("magic", "Balanced ", "fodpt", "")
NEEDED = {
    "apply": ["rig", "--gains", "1"],
    "rollback": ["rig"],
    "identify": ["absent.csv"],
    "diagnose": ["absent.csv"],
    "replay": ["absent.zip"],
    "gains": ["--model", '{"K": 2, "T": 10, "D": 1}'],
    "tune": ["rig"],
}
"""What makes a command line of a command right but for what is added."""
WHOLE_LINES = (
    ["tun"],
    ["--verison"],
    ["tune", "rig", "extra"],
    ["tune", "rgi"],
    ["tune", "rig", "--amplitude"],
    ["tune", "rig", "--amplitude", "70"],
    ["tune", "rig", "--online", "1,2,3,4"],
    ["tune", "rig", "--online", "a,b"],
    ["tune", "rig", "--verify", "small"],
    ["tune", "rig", "--apply"],
    ["tune", "rig", "--config", "absent.toml"],
    ["tune", "rig", "--report", "/nowhere/report.html"],
    ["tune", "rig", "--recording", "/nowhere/recording.csv"],
    ["tune", "rig", "--picture", "picture.txt"],
    ["tune", "rig", "--picture", "/nowhere/picture.png"],
    ["apply", "rig", "--gains", "1,2,3,4"],
    ["apply", "rig", "--gains", "one"],
    ["apply", "rig", "--from", "absent.json"],
    ["gains", "--model", "{"],
    ["gains", "--model", "[1]"],
    ["gains", "--model", '{"K": 0, "T": 1, "D": 1}'],
    ["identify", "a.csv", "--columns", "pv"],
    ["identify", "a.csv", "--window", "9:1"],
    ["identify", "a.csv", "b.csv", "--picture", "p.png"],
    ["token", "add", "anna", "--role", "boss"],
    ["completion", "csh"],
    ["bench", "nothing"],
)


def wrong_lines():
    """Return wrong command lines, each with the words that its answer must hold."""
    parser, _ = command_line(None, whole=True)
    lines = [(line, ()) for line in WHOLE_LINES]
    for name, start in NEEDED.items():
        options = parser.commands()[name].options()
        for option, action in options.items():
            lines += [([name, *start, option, value], (option,)) for value in wrong_values(action)]
            for misspelt in (option[:-2], option[:3] + option[4:], f"{option}s"):
                if len(misspelt) > 4 and misspelt not in options:
                    lines.append(([name, *start, misspelt], (misspelt,)))
    return lines


def wrong_values(action):
    match action.type:
        case Number():
            below = [f"{action.type.low - 1.0:g}"] if action.type.low > -1e300 else []
            return (*NO_NUMBERS, *below, *(["0"] if action.type.above == 0.0 else []))
        case WholeNumber():
            return NO_WHOLE_NUMBERS
        case OneOf():
            return NO_NAMES
    return ()


def prepared(folder):
    """Make a file of loops whose device leaves a mark when it is touched; return the mark."""
    mark = folder / "touched"
    (folder / "touched_rig.py").write_text(RIG.format(mark=str(mark)), encoding="utf-8")
    (folder / "autotuner.toml").write_text(LOOP.format(folder=str(folder)), encoding="utf-8")
    return mark


def is_answer(text, words):
    """Return whether a text is one line of ours with a field, a value or a name, and a remedy."""
    found = text.strip()
    return (
        found.startswith("autotuner: ")
        and "\n" not in found
        and found.count(": ") >= 2
        and ". " in found
        and all(word in found for word in words)
    )


def processor_s():
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def measured(count, seed):
    lines = wrong_lines()
    if count < len(lines):
        lines = random.Random(seed).sample(lines, count)  # noqa: S311 - which lines are drawn is no secret
    took, spent, answered, codes = [], [], 0, []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mark = prepared(folder)
        environment = {**os.environ, "XDG_STATE_HOME": name}
        for line, words in lines:
            began, before_s = time.perf_counter(), processor_s()
            done = subprocess.run(  # noqa: S603 - ourselves
                [sys.executable, "-m", "autotuner", *line],
                cwd=folder, env=environment, capture_output=True, text=True, check=False,
            )  # fmt: skip
            took.append(time.perf_counter() - began)
            spent.append(processor_s() - before_s)
            answered += is_answer(done.stderr, words)
            codes.append(done.returncode)
            if not is_answer(done.stderr, words) or done.returncode not in (1, 2):
                print(f"{done.returncode} {' '.join(line)}: {done.stderr.strip()}")
        touched = mark.exists()
    print(f"lines {len(lines)}, answered {answered}, exit codes {sorted(set(codes))}, device touched {touched}")
    for name, seconds in (("seconds", took), ("of the processor", spent)):
        print(f"{name}: median {statistics.median(seconds):.2f}, longest {max(seconds):.2f}")
    return 0 if answered == len(lines) and not touched else 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    sys.exit(measured(args.count, args.seed))
