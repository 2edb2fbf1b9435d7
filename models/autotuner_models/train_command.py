"""`autotuner train`: the learned correction made from nothing: experiments, networks, artefacts, model card."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autotuner.errors import ConfigurationError
from autotuner_models.learned.card import write_card
from autotuner_models.learned.draw import RATIOS, STRUCTURES, Conditions
from autotuner_models.learned.generation import BATCH, Plan, generate
from autotuner_models.learned.training import FAMILIES, NETWORK, assembled, train, train_classifier

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from autotuner_models.learned.draw import Rowset
    from autotuner_models.learned.training import Classifier, Trained

EXPERIMENTS = 204_800
"""Simulated experiments of a training: those of the shipped models."""
SEED = 20
"""Seed of the shipped models."""
CHUNKS = "chunks"
MOST_NOISE = 1.0
"""Standard deviation of the noise, over the amplitude, beyond which no oscillation can be read."""


@dataclass(frozen=True, slots=True)
class TrainCommand:
    """Train the learned correction."""

    help: str = "Train the learned correction on simulated experiments and write its files."

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument(
            "--out",
            "--output",
            type=Path,
            default=Path("autotuner-learned"),
            metavar="DIR",
            help="folder for the files",
        )
        parser.add_argument(
            "--range",
            action="append",
            type=ratio_range,
            default=[],
            metavar="NAME=LOW..HIGH",
            help="range of a ratio of the processes, instead of the usual one; may be repeated: " + ", ".join(RATIOS),
        )
        parser.add_argument(
            "--noise",
            type=noise_range,
            default=Conditions().noise,
            metavar="LOW..HIGH",
            help="range of the noise's standard deviation over the amplitude (0..0.25)",
        )
        parser.add_argument("--family", choices=list(FAMILIES), default=NETWORK, help="what is trained")
        parser.add_argument("--work", type=Path, help="folder for the experiments; begun ones go on (DIR/chunks)")
        parser.add_argument("--experiments", type=int, default=EXPERIMENTS, help="how many to simulate, about")
        parser.add_argument("--seed", type=int, default=SEED, help="of experiments and networks")
        parser.add_argument("--jobs", type=int, default=1, help="processes")
        parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster that simulates")
        parser.add_argument("--json", action="store_true", help="print the manifest as one JSON object")
        parser.epilog = (
            "examples:\n  autotuner train --out learned --jobs 4\n"
            "  autotuner train --noise 0..0.05 --experiments 20000 --work experiments"
        )

    def run(self, args: argparse.Namespace) -> int:
        """Train; 1 when the folder cannot be written or the cluster cannot be reached."""
        try:
            _require_writable(args.out)
            manifest = make(args)
        except (ConfigurationError, OSError, ImportError) as error:
            sys.stderr.write(f"autotuner: {error}\n")
            return 1
        if args.json:
            sys.stdout.write(json.dumps(manifest) + "\n")
        else:
            sys.stdout.write(f"Written to {args.out}: {manifest['experiments']} experiments, see model-card.md\n")
        return 0


command = TrainCommand()


def ratio_range(text: str) -> tuple[str, tuple[float, float]]:
    """Return the name and the limits of a ratio, from `NAME=LOW..HIGH`."""
    name, _, limits = text.partition("=")
    if name not in RATIOS:
        raise argparse.ArgumentTypeError(f"{name!r} is not a ratio; use one of {', '.join(RATIOS)}")
    low, high = _limits(limits)
    if not 0.0 < low < high:
        raise argparse.ArgumentTypeError(f"{limits!r} is not a range above zero, such as 0.05..8")
    return name, (low, high)


def noise_range(text: str) -> tuple[float, float]:
    """Return the limits of the noise, from `LOW..HIGH`."""
    low, high = _limits(text)
    if not 0.0 <= low < high <= MOST_NOISE:
        raise argparse.ArgumentTypeError(f"{text!r} is not a range within 0..{MOST_NOISE:g}, such as 0..0.1")
    return low, high


def _limits(text: str) -> tuple[float, float]:
    low, _, high = text.partition("..")
    try:
        limits = float(low), float(high)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not LOW..HIGH") from None
    if not all(math.isfinite(value) for value in limits):
        raise argparse.ArgumentTypeError(f"{text!r} is not finite")
    return limits


def make(args: argparse.Namespace) -> dict[str, object]:
    """Simulate, train and write; return the manifest."""
    from autotuner_models.learned.artefacts import read_manifest, save  # noqa: PLC0415 - after the arguments are known

    given = Conditions(ranges=dict(args.range), noise=args.noise)
    plan = Plan(args.seed, max(1, round(args.experiments / (BATCH * len(STRUCTURES)))), given)
    with _shown("simulating") as progress:
        rows, digest = generate(plan, args.work or args.out / CHUNKS, args.jobs, args.dask, progress)
    with _shown("training") as progress:
        trained, (classifier, arrays, domain, right) = _trained(rows, args.seed, args.family, args.jobs, progress)
    objects = {name: one.pipelines for name, one in trained.items()} | {"classes": classifier}
    about = {
        "seed": args.seed,
        "family": args.family,
        "ranges": {name: list(span) for name, span in (RATIOS | given.ranges).items()},
        "noise": list(given.noise),
        "experiments": plan.experiments,
        "data_sha256": digest,
        "metrics": {name: one.metrics for name, one in trained.items()} | {"classes": right},
    }
    save(args.out, assembled(trained, arrays, domain), objects, about)
    manifest = read_manifest(args.out)
    write_card(args.out, manifest, trained)
    return manifest


def _trained(
    rows: Mapping[str, Rowset], seed: int, family: str, jobs: int, progress: Callable[[int, int], None]
) -> tuple[dict[str, Trained], Classifier]:
    """Train the corrections and the classifier of structures in parallel; the result does not depend on the workers."""
    import joblib  # noqa: PLC0415 - after the arguments are known

    work = [joblib.delayed(train_classifier)({s: rows[s].shape for s in STRUCTURES}, seed)]
    work += [joblib.delayed(train)(rows[s], seed, family=family, compare=family == NETWORK) for s in STRUCTURES]
    done: list[Any] = []
    for one in joblib.Parallel(n_jobs=jobs, return_as="generator")(work):
        progress(len(done), len(work))
        done.append(one)
    progress(len(done), len(work))
    return dict(zip(STRUCTURES, done[1:], strict=True)), done[0]


def _require_writable(folder: Path) -> None:
    """Refuse before the work, not after it."""
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise ConfigurationError(
            "may not be written to", field="--out", value=str(folder), remedy="Give a folder that may be written to."
        )


class _shown:  # noqa: N801 - reads as a word where it is used
    """A bar on a terminal, nothing in a pipe."""

    def __init__(self, title: str) -> None:
        self._title = title

    def __enter__(self) -> Callable[[int, int], None]:
        from rich.console import Console  # noqa: PLC0415
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: PLC0415

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty())
        task = self._bar.add_task(self._title)
        self._bar.start()
        return lambda done, total: self._bar.update(task, completed=done, total=total)

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
