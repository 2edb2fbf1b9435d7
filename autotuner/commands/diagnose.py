"""`autotuner diagnose`: effects that a recording shows and a model lacks."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.application.computing.cluster import on_cluster
from autotuner.commands.files.result_files import check_writable, write_file
from autotuner.commands.identify import parse_columns, parse_window
from autotuner.commands.terminal.output import exit_code, say, show, writing
from autotuner.commands.terminal.usage import Number, WholeNumber, add_examples
from autotuner.core.recording import Recording
from autotuner.errors import AutotunerError, InputError, RecordingError

if TYPE_CHECKING:
    import argparse

    from autotuner.core.diagnosis import Diagnosis
    from autotuner.core.model.process import ProcessModel


@dataclass(frozen=True, slots=True)
class DiagnoseCommand:
    """Diagnose files."""

    help: str = (
        "Find effects in a recording that a model lacks: friction, limits, curves, further lags, disturbances, sensor. "
        "CSV recordings with the header t,u,y; further columns count as measured disturbances."
    )

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="CSV recordings")
        parser.add_argument(
            "--model", type=Path, metavar="MODEL.json", help="the declared model; else it is identified"
        )
        parser.add_argument(
            "--columns", metavar="t=NAME,u=NAME,y=NAME", help="which columns to use, by title or number from 1"
        )
        parser.add_argument("--window", metavar="START:END", help="part of the recording, s")
        parser.add_argument(
            "--time-limit", type=Number(above=0.0), metavar="SECONDS", help="time limit of the search of each file"
        )
        parser.add_argument("--jobs", type=WholeNumber(1), metavar="N", default=1, help="files at once (%(default)s)")
        parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster that diagnoses the files")
        results = parser.add_argument_group("results")
        results.add_argument("--json", action="store_true", help="print one JSON object a line per file")
        results.add_argument("--report", type=Path, metavar="OUT.html", help="write a report (one recording)")
        add_examples(
            parser,
            "autotuner diagnose relay.csv --report relay.html",
            "autotuner diagnose *.csv --model model.json --json --jobs 4",
        )

    def run(self, args: argparse.Namespace) -> int:
        """Diagnose each file; a file that fails does not stop the others."""
        import joblib  # noqa: PLC0415 - keeps `--help` quick
        from joblib.externals.loky import get_reusable_executor  # noqa: PLC0415

        if args.report is not None and len(args.files) > 1:
            raise InputError(
                "is of one recording only", field="--report", value=len(args.files), remedy="Give one file."
            )
        if args.report is not None:
            check_writable("--report", args.report)
        columns, window = parse_columns(args.columns), parse_window(args.window)
        model = None if args.model is None else _model(args.model)
        files = _largest_first(args.files) if args.dask else args.files
        work = (
            joblib.delayed(diagnose_file)(file, _content(file), columns, window, model, args.time_limit)
            for file in files
        )
        try:
            with on_cluster(args.dask):  # uses all workers; returns a complete list only
                jobs, kind = (-1, "list") if args.dask else (args.jobs, "generator")
                results = joblib.Parallel(n_jobs=jobs, return_as=kind)(work)
                if args.dask:
                    made = dict(zip(files, results, strict=True))
                    results = (made[file] for file in args.files)
                return max(_show(file, result, args) for file, result in zip(args.files, results, strict=True))
        finally:
            if args.jobs != 1 and not args.dask:
                get_reusable_executor().shutdown(wait=True)


command = DiagnoseCommand()


def _model(file: Path) -> ProcessModel:
    from autotuner.core.model.process import model_from_dict  # noqa: PLC0415 - keeps `--help` quick

    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot be read: {error}", field=str(file), remedy='Write {"structure": "fopdt", "K": 2, "T": 10, "D": 1}.'
        ) from error
    if not isinstance(content, dict):
        raise InputError("is no JSON object", field=str(file), remedy="Give a model by its parameters.")
    inner = content.get("model")
    values = {"structure": content.get("structure"), **inner} if isinstance(inner, dict) else content
    return model_from_dict(values)


def _largest_first(files: list[Path]) -> list[Path]:
    """Return files with the longest first, so that no worker starts a long file at the end."""
    return sorted(files, key=lambda file: file.stat().st_size if file.exists() else 0, reverse=True)


def _content(file: Path) -> bytes | RecordingError:
    """Return the content of a file, because a worker on another machine does not have it."""
    try:
        return file.read_bytes()
    except OSError as error:
        return RecordingError(
            f"cannot be read: {error.strerror}", field=str(file), remedy="Check the path and its permissions."
        )


def diagnose_file(
    file: Path,
    content: bytes | RecordingError,
    columns: dict[str, str] | None,
    window: tuple[float, float] | None,
    model: ProcessModel | None,
    time_limit_s: float | None = None,
) -> Diagnosis | AutotunerError:
    """Diagnose the content of a file; return an error instead of raising, so that it can cross processes."""
    from autotuner.application.analysis.diagnosis import diagnose  # noqa: PLC0415 - keeps `--help` quick

    if isinstance(content, RecordingError):
        return content
    try:
        recording = Recording.from_csv_bytes(content, str(file), columns)
        part = recording if window is None else recording.window(*window)
        on_progress = partial(_progress, file) if sys.stderr.isatty() else None
        return diagnose(part, model, time_limit_s=time_limit_s, on_progress=on_progress)
    except AutotunerError as error:
        return error


def _progress(file: Path, sentence: str) -> None:
    say(f"{file}: {sentence}")


def _show(file: Path, result: Diagnosis | AutotunerError, args: argparse.Namespace) -> int:
    if isinstance(result, AutotunerError):
        say(result)
        if args.json:
            show(json.dumps({"file": str(file), "error": result.to_dict()}) + "\n")
        return exit_code(result)
    if args.report is not None:
        _write(args.report, result, file.name)
    if args.json:
        show(json.dumps({"file": str(file), **result.to_dict()}) + "\n")
    else:
        with writing():
            _print(file, result, args.report)
    return 0


def _write(report: Path, diagnosis: Diagnosis, name: str) -> None:
    from autotuner.reports.diagnosis import diagnosis_report  # noqa: PLC0415 - only a report needs it

    text = diagnosis_report(diagnosis, name)
    write_file("--report", report, lambda place: place.write_text(text, encoding="utf-8"))


def _print(file: Path, diagnosis: Diagnosis, report: Path | None) -> None:
    from autotuner.commands.terminal.show import results_console  # noqa: PLC0415 - rich is slow to load

    console = results_console()
    console.print(f"[bold]{file}[/bold]: [bold]{diagnosis.verdict}[/bold]: {diagnosis.summary}")
    for effect in diagnosis.effects:
        console.print(f"  [bold]{effect.title}[/bold] ({effect.place}), confidence {effect.confidence:.0%}")
        for name, value in effect.parameters.items():
            interval = effect.interval95.get(name)
            content = "" if interval is None else f"  (95 %: {interval[0]:.4g} to {interval[1]:.4g})"
            console.print(f"    {name} {f'{value:.4g} {effect.units[name]}'.rstrip()}{content}")
        console.print(f"    {effect.advice}")
    for part, misfit in diagnosis.error.items():
        errors = f"{misfit.before:.4g} to {misfit.after:.4g} PV (noise {misfit.noise:.4g} PV)"
        console.print(f"  error {part.replace('_', ' ')}: {errors}")
    for note in diagnosis.notes:
        console.print(f"  [yellow]note:[/yellow] {note}")
    if report is not None:
        console.print(f"  report: {report}")
