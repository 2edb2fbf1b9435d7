"""`autotuner replay`: the analysis of an exported tuning again."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.commands.terminal.output import show
from autotuner.commands.terminal.usage import add_examples

if TYPE_CHECKING:
    import argparse

    from autotuner.service.archive.export import Exported, Replay


@dataclass(frozen=True, slots=True)
class ReplayCommand:
    """Analyse again."""

    help: str = (
        "Analyse the recording of an exported tuning again, and compare: exit code 0 when every part of the result is "
        "what it was to the last digit, 1 when one differs."
    )

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument("file", type=Path, metavar="FILE", help="file of GET /v1/tunings/ID/export")
        parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
        add_examples(parser, "autotuner replay tuning.zip", "autotuner replay tuning.zip --json")

    def run(self, args: argparse.Namespace) -> int:
        """Analyse and compare."""
        from autotuner.service.archive.export import read_export, replayed  # noqa: PLC0415 - keeps `--help` quick

        tuning = read_export(args.file)
        again = replayed(tuning)
        show(_as_json(tuning, again) if args.json else _in_words(tuning, again))
        return 1 if again.differing else 0


command = ReplayCommand()


def _as_json(tuning: Exported, again: Replay) -> str:
    content = {
        "tuning": tuning.id,
        "identical": not again.differing,
        "compared": again.compared,
        "differing": again.differing,
        "versions_then": tuning.versions,
        "versions_now": versions_now(),
        "result": again.result,
    }
    return json.dumps(content, allow_nan=False) + "\n"


def _in_words(tuning: Exported, again: Replay) -> str:
    lines = [f"tuning {tuning.id}, {len(tuning.recording)} samples: {again.result['verdict']['code']}"]
    now = versions_now()
    lines += [
        f"  {name} {then} then, {now.get(name, 'none')} now"
        for name, then in tuning.versions.items()
        if now.get(name) != then
    ]
    if not again.compared:
        lines.append("it was not analysed then: there is nothing to compare")
    elif again.differing:
        lines.append(f"differs: {', '.join(again.differing)}")
    else:
        lines.append(f"identical: {', '.join(again.compared)}")
    return "\n".join(lines) + "\n"


def versions_now() -> dict[str, str]:
    """Return the computation of analyses in this process."""
    from autotuner.service.archive.archiver import VERSIONS  # noqa: PLC0415 - keeps `--help` quick

    return VERSIONS
